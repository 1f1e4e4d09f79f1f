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

#include "pc/common.hpp"
#include "pc/sixteen.hpp"
#include "pc/neighbors/nearest.hpp"
#include "pc/neighbors/tree_search.hpp"

namespace pc {

// What Python knows of a batch on depth images; camera null: the points are in the camera's frame.
struct Grid {
  const int64_t* pixel;  // (N,) v * width + u, increasing within a cloud
  int64_t width;
  const double* camera;  // (B, 4, 4) rigid, camera from points; or null
};

// A rigid motion into the camera's frame.
struct CameraFrame {
  const double* matrix;  // (4, 4), or null for none

  // Sixteen points; every coordinate is rounded once, at the end.
  void move(Floats& x, Floats& y, Floats& z) const {
    if (matrix == nullptr) return;
    alignas(64) float from[3][kQueries], to[3][kQueries];
    x.store(from[0]), y.store(from[1]), z.store(from[2]);
    for (int axis = 0; axis < 3; ++axis) {
      const double* m = matrix + 4 * axis;
      for (int lane = 0; lane < kQueries; ++lane)
        to[axis][lane] = static_cast<float>(m[0] * from[0][lane] + m[1] * from[1][lane] + m[2] * from[2][lane] + m[3]);
    }
    x = Floats::load(to[0]), y = Floats::load(to[1]), z = Floats::load(to[2]);
  }
};

// The half-spaces that hold all points from some column (or row) on, one per column: normal form a, b.
struct HalfSpaces {
  // Distance from a query at (X0, Z0): b Z0 - a X0 to the points from column c on, a X0 - b Z0 to those up to column c.
  float *from_a, *from_b, *upto_a, *upto_b;

  // Column c stands at place c; `before` and `after` places are added, where there is nothing beyond.
  void build(ScratchFrame& scratch, const float* least, const float* most, int64_t count, int64_t before,
             int64_t after) {
    float* room = scratch.take<float>(4 * (before + count + after));
    const int64_t stride = before + count + after;
    from_a = room + before;
    from_b = from_a + stride;
    upto_a = from_b + stride;
    upto_b = upto_a + stride;
    float slope = kInfinity;
    for (int64_t c = count + after - 1; c >= -before; --c) {
      if (c >= 0 && c < count) slope = std::min(slope, least[c]);
      set(slope, from_a[c], from_b[c]);
    }
    slope = -kInfinity;
    for (int64_t c = -before; c < count + after; ++c) {
      if (c >= 0 && c < count) slope = std::max(slope, most[c]);
      set(slope, upto_a[c], upto_b[c]);
    }
  }

 private:
  static void set(float slope, float& a, float& b) {
    const double length = std::sqrt(1.0 + double{slope} * slope);
    const bool nothing = slope == kInfinity || slope == -kInfinity;
    a = nothing ? 0.0f : static_cast<float>(1.0 / length);
    b = nothing ? slope : static_cast<float>(slope / length);
  }
};

// One cloud laid out as the part of its image that it covers, with a margin of points at infinity.
class OrganisedCloud {
 public:
  // False when the cloud cannot be searched by windows with profit: points behind the camera, or far fewer points than
  // pixels.
  bool build(const pc_context& context, ScratchFrame& scratch, const float* points, const Grid& grid, int64_t cloud,
             int64_t begin, int64_t end, int max_reach) {
    max_reach_ = max_reach;
    camera_ = {grid.camera == nullptr ? nullptr : grid.camera + 16 * cloud};
    if (!measure(context, grid, begin, end)) return false;
    const int64_t rows = height_ + 2 * max_reach;
    stride_ = (width_ + max_reach + kQueries - 1) / kQueries * kQueries + kQueries + 2 * max_reach;
    if (rows * stride_ > kMaxPixelsPerPoint * (end - begin) || rows * stride_ >= int64_t{kNoId}) return false;
    origin_ = max_reach * stride_ + max_reach;
    float* room = scratch.take<float>(3 * rows * stride_);
    for (int axis = 0; axis < 3; ++axis) image_[axis] = room + axis * rows * stride_ + origin_;
    row_of_pixel_ = scratch.take<uint32_t>(rows * stride_) + origin_;
    parallel_for(context, rows, kRowsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      for (int axis = 0; axis < 3; ++axis)
        std::fill(image_[axis] - origin_ + first * stride_, image_[axis] - origin_ + last * stride_, kInfinity);
    });
    parallel_for(context, end - begin, kPointsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      for_pixels(grid, begin + first, begin + last, [&](int64_t i, int64_t u, int64_t v) {
        const int64_t at = (v - first_row_) * stride_ + (u - first_column_);
        for (int axis = 0; axis < 3; ++axis) image_[axis][at] = points[3 * i + axis];
        row_of_pixel_[at] = static_cast<uint32_t>(i);
      });
    });
    return measure_slopes(context, scratch);
  }

  // The cloud as leaves of 4x4 pixels, in Morton order within tiles of 64x64: near in the image is mostly near in space,
  // and it takes no sort. Missing pixels leave empty slots anywhere in a leaf.
  Leaves tile_leaves(const pc_context& context, ScratchFrame& scratch) const {
    const int64_t across = (width_ + kTile - 1) / kTile, tiles = across * ((height_ + kTile - 1) / kTile);
    constexpr int64_t kLeaves = kTile / kLeafSide * (kTile / kLeafSide);
    int64_t* leaf_ptr = scratch.take<int64_t>(2);
    leaf_ptr[0] = 0;
    leaf_ptr[1] = tiles * kLeaves;
    Leaf* leaves = scratch.take<Leaf>(tiles * kLeaves);
    parallel_for(context, tiles, 2, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t i = first * kLeaves; i < last * kLeaves; ++i) {
        const int64_t tile = i / kLeaves, code = i % kLeaves;
        fill_leaf_at(tile % across * kTile + kLeafSide * even_bits(code),
                     tile / across * kTile + kLeafSide * even_bits(code >> 1), leaves[i]);
      }
    });
    return {leaves, leaf_ptr, 1};
  }

  int64_t width() const { return width_; }
  int64_t height() const { return height_; }
  int64_t stride() const { return stride_; }
  int max_reach() const { return max_reach_; }
  const CameraFrame& camera() const { return camera_; }
  const float* x() const { return image_[0]; }
  const float* y() const { return image_[1]; }
  const float* z() const { return image_[2]; }
  uint32_t row(int64_t pixel) const { return row_of_pixel_[pixel]; }
  const HalfSpaces& columns() const { return columns_; }
  const HalfSpaces& lines() const { return lines_; }

 private:
  // An image with fewer points in it is mostly searched in vain.
  static constexpr int64_t kMaxPixelsPerPoint = 4;
  static constexpr int64_t kTile = 64, kLeafSide = 4;
  static constexpr int64_t kRowsPerPiece = 16;
  static constexpr int64_t kPointsPerPiece = 1 << 14;
  static constexpr float kMinDepth = 1e-30f, kMaxSlope = 1e18f;  // so that no slope overflows

  // Bits 0, 2, 4 and 6 of a number, moved together.
  static int64_t even_bits(int64_t v) { return (v & 1) | (v >> 1 & 2) | (v >> 2 & 4) | (v >> 3 & 8); }

  // A leaf may reach over the edge of the image, into the margin.
  void fill_leaf_at(int64_t u, int64_t v, Leaf& leaf) const {
    const bool outside = u >= width_ || v >= height_;
    float* value[3] = {leaf.x, leaf.y, leaf.z};
    for (int64_t i = 0; i < kLeafSize; ++i) {
      const int64_t at = outside ? 0 : (v + i / kLeafSide) * stride_ + u + i % kLeafSide;
      for (int axis = 0; axis < 3; ++axis) value[axis][i] = outside ? kInfinity : image_[axis][at];
      leaf.row[i] = leaf.z[i] < kInfinity ? row_of_pixel_[at] : kNoId;
    }
  }

  template <class Body>
  static void for_pixels(const Grid& grid, int64_t begin, int64_t end, Body&& body) {
    int64_t v = begin < end ? grid.pixel[begin] / grid.width : 0;
    for (int64_t i = begin; i < end; ++i) {
      int64_t u = grid.pixel[i] - v * grid.width;
      if (u >= grid.width) {
        v = grid.pixel[i] / grid.width;
        u = grid.pixel[i] - v * grid.width;
      }
      body(i, u, v);
    }
  }

  // The rectangle of pixels that the cloud covers.
  bool measure(const pc_context& context, const Grid& grid, int64_t begin, int64_t end) {
    if (begin == end) return false;
    first_row_ = grid.pixel[begin] / grid.width;
    height_ = grid.pixel[end - 1] / grid.width - first_row_ + 1;
    struct alignas(64) Range {
      int64_t least, most;
    };
    std::vector<Range> ranges(static_cast<size_t>(std::max(context.threads, 1)), Range{grid.width, -1});
    parallel_for(context, end - begin, kPointsPerPiece, [&](int64_t first, int64_t last, int64_t thread) {
      Range range = ranges[static_cast<size_t>(thread)];
      for_pixels(grid, begin + first, begin + last, [&](int64_t, int64_t u, int64_t) {
        range = {std::min(range.least, u), std::max(range.most, u)};
      });
      ranges[static_cast<size_t>(thread)] = range;
    });
    first_column_ = grid.width;
    int64_t last_column = 0;
    for (const Range& range : ranges) {
      first_column_ = std::min(first_column_, range.least);
      last_column = std::max(last_column, range.most);
    }
    width_ = last_column - first_column_ + 1;
    return true;
  }

  bool measure_slopes(const pc_context& context, ScratchFrame& scratch) {
    const int64_t bands = (height_ + kRowsPerPiece - 1) / kRowsPerPiece;
    const int64_t columns = (width_ + kQueries - 1) / kQueries * kQueries;
    float* column = scratch.take<float>(2 * bands * columns);  // least, then most, of each band
    float* line = scratch.take<float>(2 * height_);
    std::atomic<bool> in_front{true};
    parallel_for(context, bands, 1, [&](int64_t band, int64_t, int64_t) {
      float *least = column + 2 * band * columns, *most = least + columns;
      std::fill(least, most, kInfinity);
      std::fill(most, most + columns, -kInfinity);
      bool fine = true;
      for (int64_t v = band * kRowsPerPiece, end = std::min(height_, v + kRowsPerPiece); v < end; ++v)
        fine &= slopes_of_line(v, least, most, line[v], line[height_ + v]);
      if (!fine) in_front.store(false, std::memory_order_relaxed);
    });
    if (!in_front.load()) return false;
    for (int64_t band = 1; band < bands; ++band)
      for (int64_t u = 0; u < width_; ++u) {
        column[u] = std::min(column[u], column[2 * band * columns + u]);
        column[columns + u] = std::max(column[columns + u], column[(2 * band + 1) * columns + u]);
      }
    columns_.build(scratch, column, column + columns, width_, max_reach_ + 1, max_reach_ + 1 + kQueries);
    lines_.build(scratch, line, line + height_, height_, max_reach_ + 1, max_reach_ + 1);
    return true;
  }

  // Missing pixels are at infinity, so their slopes are NaN, and a minimum with NaN gives the second value.
  bool slopes_of_line(int64_t v, float* least, float* most, float& line_least, float& line_most) const {
    Floats low(kInfinity), high(-kInfinity);
    LaneMask bad = 0;
    for (int64_t u = 0; u < width_; u += kQueries) {
      const int64_t at = v * stride_ + u;
      Floats x = Floats::load(image_[0] + at), y = Floats::load(image_[1] + at), z = Floats::load(image_[2] + at);
      const LaneMask real = less(z, Floats(kInfinity));
      camera_.move(x, y, z);
      const Floats inverse = Floats(1.0f) / z, across = x * inverse, down = y * inverse;
      // Every comparison is false for NaN, which so counts as bad.
      bad |= real & ~(less(Floats(kMinDepth), z) & less(z, Floats(kInfinity)) & within(across) & within(down));
      minimum(across, Floats::load(least + u)).store(least + u);
      maximum(across, Floats::load(most + u)).store(most + u);
      low = minimum(down, low);
      high = maximum(down, high);
    }
    line_least = -largest(Floats(0.0f) - low);
    line_most = largest(high);
    return bad == 0;
  }
  static LaneMask within(const Floats& slope) {
    return less(slope, Floats(kMaxSlope)) & less(Floats(-kMaxSlope), slope);
  }

  int64_t first_row_ = 0, first_column_ = 0, width_ = 0, height_ = 0, stride_ = 0, origin_ = 0;
  int max_reach_ = 0;
  CameraFrame camera_{nullptr};
  float* image_[3] = {};
  uint32_t* row_of_pixel_ = nullptr;
  HalfSpaces columns_{}, lines_{};
};

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
  WindowSearch(const OrganisedCloud& cloud, const WindowRings& rings) : cloud_(cloud), rings_(rings) {}

  // The points at pixels (u, v) to (u+15, v).
  QueryGroup queries_at(int64_t u, int64_t v) const {
    const int64_t at = v * cloud_.stride() + u;
    return QueryGroup(cloud_.x() + at, cloud_.y() + at, cloud_.z() + at);
  }

  // Offer windows of growing size, from `reach` on; return the lanes that are proved complete.
  template <class Nearest>
  LaneMask run(const QueryGroup& queries, int64_t u, int64_t v, int reach, Nearest& nearest) {
    u_ = u;
    v_ = v;
    for (int ring = 0; ring <= reach; ++ring) offer_ring(queries, ring, nearest);
    const Place place(cloud_, queries);
    for (;; offer_ring(queries, ++reach, nearest)) {
      nearest.settle();
      reach_ = reach;
      const LaneMask proved = less(nearest.bound(), clear_within(place, reach)) & queries.active;
      if (proved == queries.active || reach == cloud_.max_reach()) return proved;
      // Rings cost all lanes: go on only for those that the largest window would prove.
      if ((less(nearest.bound(), clear_within(place, cloud_.max_reach())) & queries.active & ~proved) == 0)
        return proved;
    }
  }

  // Show again every pixel of the last window: body(x, y, z, id), where row_in_lane(id, lane) is the point's row.
  template <class Body>
  void replay(const QueryGroup&, const Floats&, Body&& body) const {
    for (int ring = 0; ring <= reach_; ++ring)
      for (auto offset = rings_.begin(ring); offset != rings_.end(ring); ++offset) {
        const int64_t at = pixel(*offset);
        body(Floats::load(cloud_.x() + at), Floats::load(cloud_.y() + at), Floats::load(cloud_.z() + at),
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
    Floats x, y, z, slack;

    Place(const OrganisedCloud& cloud, const QueryGroup& queries) : x(queries.x), y(queries.y), z(queries.z) {
      cloud.camera().move(x, y, z);
      const Floats zero(0.0f);
      slack = (maximum(x, zero - x) + maximum(y, zero - y) + z) * Floats(1e-6f);
    }
  };

  template <class Nearest>
  void offer_ring(const QueryGroup& queries, int ring, Nearest& nearest) const {
    for (auto offset = rings_.begin(ring); offset != rings_.end(ring); ++offset) {
      const int64_t at = pixel(*offset);
      const Floats squared = squared_length(Floats::load(cloud_.x() + at) - queries.x,
                                            Floats::load(cloud_.y() + at) - queries.y,
                                            Floats::load(cloud_.z() + at) - queries.z);
      if (nearest.wants(squared)) nearest.offer(squared, Ids::ascending(static_cast<uint32_t>(at)));
    }
  }

  // The squared distance within which every point is in the window, per lane.
  Floats clear_within(const Place& at, int reach) const {
    const HalfSpaces &columns = cloud_.columns(), &lines = cloud_.lines();
    const int64_t right = u_ + reach + 1, left = u_ - reach - 1, below = v_ + reach + 1, above = v_ - reach - 1;
    const Floats to_right = Floats::load(columns.from_b + right) * at.z - Floats::load(columns.from_a + right) * at.x;
    const Floats to_left = Floats::load(columns.upto_a + left) * at.x - Floats::load(columns.upto_b + left) * at.z;
    const Floats to_below = Floats(lines.from_b[below]) * at.z - Floats(lines.from_a[below]) * at.y;
    const Floats to_above = Floats(lines.upto_a[above]) * at.y - Floats(lines.upto_b[above]) * at.z;
    const Floats nearest_side = minimum(minimum(to_right, to_left), minimum(to_below, to_above));
    const Floats clear = maximum(nearest_side - at.slack, Floats(0.0f));
    return clear * clear * Floats(kMargin);
  }

  int64_t pixel(const WindowRings::Offset& offset) const {
    return (v_ + offset.dv) * cloud_.stride() + u_ + offset.du;
  }

  // Rounding of computed squared distances (4e-7), and motions that are rigid only to 1e-5 (ImageGrid requires it).
  static constexpr float kMargin = 1.0f - 1e-4f;

  const OrganisedCloud& cloud_;
  const WindowRings& rings_;
  int64_t u_ = 0, v_ = 0;
  int reach_ = 0;
};

}  // namespace pc
