// The search of a cloud that still lies on a depth image: a window of pixels, with proof that nothing nearer lies
// outside.
//
// The proof. Let S be the least X/Z of all points in the columns from u+w+1 on, in the camera's frame, where Z > 0. All
// of those points lie in the half-space X >= S Z, so a query left of it is at least (S Z0 - X0) / sqrt(1 + S^2) away
// from them; likewise for the columns up to u-w-1 and for rows. If the k-th distance found in the window of half-width
// w is less than all four, no point outside can matter. S is measured from the points, not computed from intrinsics, so
// a grid that does not fit the points (or a lens that bends columns) can only make proofs fail, never make them wrong;
// queries without a proof go to the box tree.
#pragma once

#include <algorithm>
#include <cstdlib>
#include <vector>

#include "pc/neighbors/organized_cloud.hpp"
#include "pc/neighbors/tree_search.hpp"

namespace pc::neighbors {

// The pixels at each distance from the middle of a window, square ring by square ring, nearest first within a ring.
class WindowRings {
 public:
  explicit WindowRings(int max_reach) {
    for (int ring = 0; ring <= max_reach; ++ring) {
      begin_.push_back(offsets_.size());
      for (int dv = -ring; dv <= ring; ++dv)
        for (int du = -ring; du <= ring; ++du)
          if (std::max(std::abs(du), std::abs(dv)) == ring) offsets_.push_back({du, dv});
      std::stable_sort(offsets_.begin() + static_cast<ptrdiff_t>(begin_.back()), offsets_.end(),
                       [](Offset a, Offset b) { return a.squared() < b.squared(); });
    }
    begin_.push_back(offsets_.size());
  }
  struct Offset {
    int du, dv;
    int squared() const { return du * du + dv * dv; }
  };
  const Offset* begin(int ring) const { return offsets_.data() + begin_[static_cast<size_t>(ring)]; }
  const Offset* end(int ring) const { return begin(ring + 1); }

 private:
  std::vector<Offset> offsets_;
  std::vector<size_t> begin_;
};

// Searches windows around sixteen pixels side by side.
class WindowSearch {
 public:
  WindowSearch(const OrganizedCloud& cloud, const WindowRings& rings) : cloud_(cloud), rings_(rings) {}

  // The points at pixels (u, v) to (u+15, v).
  QueryGroup queries_at(int64_t u, int64_t v) const {
    const int64_t at = v * cloud_.stride() + u;
    return QueryGroup(cloud_.x() + at, cloud_.y() + at, cloud_.z() + at);
  }

  // Offer windows of growing size, from `reach` on; return the lanes that are proved complete.
  template <class Nearest>
  PackMask run(const QueryGroup& queries, int64_t u, int64_t v, int reach, Nearest& nearest) {
    u_ = u;
    v_ = v;
    for (int ring = 0; ring <= reach; ++ring) offer_ring(queries, ring, nearest);
    const Place place(cloud_, queries);
    for (;; offer_ring(queries, ++reach, nearest)) {
      nearest.settle();
      reach_ = reach;
      const PackMask proved = less(nearest.bound(), clear_within(place, reach)) & queries.active;
      if (proved == queries.active || reach == cloud_.max_reach()) return proved;
      // Rings cost all lanes: go on only for those that the largest window would prove.
      if ((less(nearest.bound(), clear_within(place, cloud_.max_reach())) & queries.active & ~proved) == 0)
        return proved;
    }
  }

  // Show again every pixel of the last window: body(x, y, z, id), where row_in_lane(id, lane) is the point's row.
  template <class Body>
  void replay(const QueryGroup&, const FloatPack&, Body&& body) const {
    for (int ring = 0; ring <= reach_; ++ring)
      for (auto offset = rings_.begin(ring); offset != rings_.end(ring); ++offset) {
        const int64_t at = pixel(*offset);
        body(FloatPack::load(cloud_.x() + at), FloatPack::load(cloud_.y() + at), FloatPack::load(cloud_.z() + at),
             static_cast<uint32_t>(at));
      }
  }
  uint32_t row(uint32_t id) const { return cloud_.row(id); }
  // The pixel of lane 0 may lie in the margin before the image, so that its number is negative and its id has wrapped:
  // the lane is added in 32 bits, where it wraps back.
  uint32_t row_in_lane(uint32_t id, int lane) const { return cloud_.row(id + static_cast<uint32_t>(lane)); }

 private:
  // The queries in the camera's frame, and how far rounding may have moved anything: a dozen roundings at most, each
  // of half a unit in the 24th bit of the largest coordinate.
  struct Place {
    FloatPack x, y, z, slack;

    Place(const OrganizedCloud& cloud, const QueryGroup& queries) : x(queries.x), y(queries.y), z(queries.z) {
      cloud.camera().move(x, y, z);
      const FloatPack zero(0.0f);
      slack = (maximum(x, zero - x) + maximum(y, zero - y) + z) * FloatPack(1e-6f);
    }
  };

  template <class Nearest>
  void offer_ring(const QueryGroup& queries, int ring, Nearest& nearest) const {
    for (auto offset = rings_.begin(ring); offset != rings_.end(ring); ++offset) {
      const int64_t at = pixel(*offset);
      const FloatPack squared =
          squared_length(FloatPack::load(cloud_.x() + at) - queries.x, FloatPack::load(cloud_.y() + at) - queries.y,
                         FloatPack::load(cloud_.z() + at) - queries.z);
      if (nearest.wants(squared)) nearest.offer(squared, Ids::ascending(static_cast<uint32_t>(at)));
    }
  }

  // The squared distance within which every point is in the window, per lane.
  FloatPack clear_within(const Place& at, int reach) const {
    const HalfSpaces &columns = cloud_.columns(), &lines = cloud_.lines();
    const int64_t right = u_ + reach + 1, left = u_ - reach - 1, below = v_ + reach + 1, above = v_ - reach - 1;
    const FloatPack to_right =
        FloatPack::load(columns.from_b + right) * at.z - FloatPack::load(columns.from_a + right) * at.x;
    const FloatPack to_left =
        FloatPack::load(columns.upto_a + left) * at.x - FloatPack::load(columns.upto_b + left) * at.z;
    const FloatPack to_below = FloatPack(lines.from_b[below]) * at.z - FloatPack(lines.from_a[below]) * at.y;
    const FloatPack to_above = FloatPack(lines.upto_a[above]) * at.y - FloatPack(lines.upto_b[above]) * at.z;
    const FloatPack nearest_side = minimum(minimum(to_right, to_left), minimum(to_below, to_above));
    const FloatPack clear = maximum(nearest_side - at.slack, FloatPack(0.0f));
    return clear * clear * FloatPack(kMargin);
  }

  int64_t pixel(const WindowRings::Offset& offset) const { return (v_ + offset.dv) * cloud_.stride() + u_ + offset.du; }

  // Rounding of computed squared distances (4e-7), and motions that are rigid only to 1e-5 (ImageGrid requires it).
  static constexpr float kMargin = 1.0f - 1e-4f;

  const OrganizedCloud& cloud_;
  const WindowRings& rings_;
  int64_t u_ = 0, v_ = 0;
  int reach_ = 0;
};

}  // namespace pc::neighbors
