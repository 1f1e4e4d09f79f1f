// Proof that nothing nearer lies outside a window of pixels.
//
// Let S be the least X/Z of all points in the columns from u+w+1 on, in the camera's frame, where Z > 0. All of those
// points lie in the half-space X >= S Z, so a query left of it is at least (S Z0 - X0) / sqrt(1 + S^2) away from them;
// likewise for the columns up to u-w-1 and for rows. If the k-th distance found in the window of half-width w is less
// than all four, no point outside can matter. S is measured from the points, not computed from intrinsics, so a grid
// that does not fit the points (or a lens that bends columns) can only make proofs fail, never make them wrong.
#pragma once

#include "pc/neighbors/organized_cloud.hpp"
#include "pc/neighbors/tree_search.hpp"

namespace pc::neighbors {

// Sixteen queries at the pixels (u, v) to (u+15, v), in the camera's frame, and how far rounding may have moved
// anything: a dozen roundings at most, each of half a unit in the 24th bit of the largest coordinate.
class Place {
 public:
  Place(const OrganizedCloud& cloud, const QueryGroup& queries, int64_t u, int64_t v)
      : cloud_(cloud), u_(u), v_(v), x_(queries.x), y_(queries.y), z_(queries.z) {
    cloud.camera().move(x_, y_, z_);
    const FloatPack zero(0.0f);
    slack_ = (maximum(x_, zero - x_) + maximum(y_, zero - y_) + z_) * FloatPack(1e-6f);
  }

  // The squared distance within which every point is in the window of this half-width, per lane.
  FloatPack clear_within(int reach) const {
    const HalfSpaces &columns = cloud_.columns(), &lines = cloud_.lines();
    const int64_t right = u_ + reach + 1, left = u_ - reach - 1, below = v_ + reach + 1, above = v_ - reach - 1;
    const FloatPack to_right =
        FloatPack::load(columns.from_b + right) * z_ - FloatPack::load(columns.from_a + right) * x_;
    const FloatPack to_left = FloatPack::load(columns.upto_a + left) * x_ - FloatPack::load(columns.upto_b + left) * z_;
    const FloatPack to_below = FloatPack(lines.from_b[below]) * z_ - FloatPack(lines.from_a[below]) * y_;
    const FloatPack to_above = FloatPack(lines.upto_a[above]) * y_ - FloatPack(lines.upto_b[above]) * z_;
    return squared_clearance(minimum(minimum(to_right, to_left), minimum(to_below, to_above)) - slack_);
  }

  // The rectangle of pixels outside of which every point of the image is farther than the square root of `bound` from
  // the query of one lane.
  struct Rectangle {
    int64_t left, right, above, below;  // inclusive
  };
  Rectangle rectangle(int lane, float bound) const {
    const HalfSpaces &columns = cloud_.columns(), &lines = cloud_.lines();
    const float x = x_[lane], y = y_[lane], z = z_[lane], slack = slack_[lane];
    const int64_t u = u_ + lane;
    const auto clear = [&](float side) { return bound < squared_clearance(side - slack); };
    return {
        u - steps(u, [&](int64_t c) { return clear(columns.upto_a[u - c] * x - columns.upto_b[u - c] * z); }),
        u + steps(cloud_.width() - 1 - u,
                  [&](int64_t c) { return clear(columns.from_b[u + c] * z - columns.from_a[u + c] * x); }),
        v_ - steps(v_, [&](int64_t c) { return clear(lines.upto_a[v_ - c] * y - lines.upto_b[v_ - c] * z); }),
        v_ + steps(cloud_.height() - 1 - v_,
                   [&](int64_t c) { return clear(lines.from_b[v_ + c] * z - lines.from_a[v_ + c] * y); }),
    };
  }

 private:
  // How far a window must reach to one side, so that `clear` holds from the next pixel on; at most `most`.
  template <class Clear>
  static int64_t steps(int64_t most, Clear&& clear) {
    int64_t reach = 0;
    for (int64_t step = 1; reach < most && !clear(reach + 1); step += reach / 8) reach = std::min(reach + step, most);
    return reach;
  }

  // Less a margin for rounding of computed squared distances (4e-7) and motions that are rigid only to 1e-5 (ImageGrid
  // requires it).
  template <class T>
  static T squared_clearance(const T& side) {
    const T clear = maximum(side, T(0.0f));
    return clear * clear * T(1.0f - 1e-4f);
  }

  const OrganizedCloud& cloud_;
  int64_t u_, v_;
  FloatPack x_, y_, z_, slack_;
};

}  // namespace pc::neighbors
