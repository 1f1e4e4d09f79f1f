// A cloud that still lies on a depth image.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>

#include "pc/math/half_space.hpp"
#include "pc/math/morton.hpp"
#include "pc/memory.hpp"
#include "pc/neighbors/leaves.hpp"
#include "pc/threads.hpp"

namespace pc::neighbors {

// What Python knows of a batch on depth images; camera null: the points are in the camera's frame.
struct Grid {
  const int64_t* pixel;  // (N,) v * width + u, increasing within a cloud
  int64_t width;
  const double* camera;  // (B, 4, 4) rigid, camera from points; or null
};

// A rigid motion into the camera's frame.
struct CameraFrame {
  const double* matrix;  // (4, 4), or null for none

  // Clouds that were never moved come with the identity.
  static CameraFrame of(const double* matrix) {
    bool moves = false;
    for (int i = 0; matrix != nullptr && i < 12; ++i) moves |= matrix[i] != (i % 5 == 0 ? 1.0 : 0.0);
    return {moves ? matrix : nullptr};
  }

  // Sixteen points; every coordinate is rounded once, at the end.
  void move(FloatPack& x, FloatPack& y, FloatPack& z) const {
    if (matrix == nullptr) return;
    alignas(64) float from[3][kQueries], to[3][kQueries];
    x.store(from[0]), y.store(from[1]), z.store(from[2]);
    for (int axis = 0; axis < 3; ++axis) {
      const double* m = matrix + 4 * axis;
      for (int lane = 0; lane < kQueries; ++lane)
        to[axis][lane] = static_cast<float>(m[0] * from[0][lane] + m[1] * from[1][lane] + m[2] * from[2][lane] + m[3]);
    }
    x = FloatPack::load(to[0]), y = FloatPack::load(to[1]), z = FloatPack::load(to[2]);
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
    const math::HalfSpace side = math::HalfSpace::of(slope);
    a = side.a;
    b = side.b;
  }
};

// One cloud laid out as the part of its image that it covers, with a margin of points at infinity.
class OrganizedCloud {
 public:
  // False when the cloud cannot be searched by windows with profit: points behind the camera, or far fewer points than
  // pixels.
  bool build(const pc_context& context, ScratchFrame& scratch, const float* points, const Grid& grid, int64_t cloud,
             int64_t begin, int64_t end, int max_reach) {
    max_reach_ = max_reach;
    camera_ = CameraFrame::of(grid.camera == nullptr ? nullptr : grid.camera + 16 * cloud);
    if (!measure(context, scratch, grid, begin, end)) return false;
    const int64_t rows = height_ + 2 * max_reach;
    stride_ = (width_ + max_reach + kQueries - 1) / kQueries * kQueries + kQueries + 2 * max_reach;
    if (rows * stride_ > kMaxPixelsPerPoint * (end - begin) || rows * stride_ >= int64_t{kNoId}) return false;
    origin_ = max_reach * stride_ + max_reach;
    float* room = scratch.take<float>(3 * rows * stride_);
    for (int axis = 0; axis < 3; ++axis) image_[axis] = room + axis * rows * stride_ + origin_;
    row_of_pixel_ = scratch.take<uint32_t>(rows * stride_) + origin_;
    return lay_out(context, scratch, points, grid);
  }

  // The cloud as leaves of 4x4 pixels, in Morton order within tiles of 64x64: near in the image is mostly near in
  // space, and it takes no sort. Missing pixels leave empty slots anywhere in a leaf.
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
        fill_leaf_at(tile % across * kTile + kLeafSide * math::even_bits(code),
                     tile / across * kTile + kLeafSide * math::even_bits(code >> 1), leaves[i]);
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
  const uint32_t* rows(int64_t pixel) const { return row_of_pixel_ + pixel; }
  const HalfSpaces& columns() const { return columns_; }
  const HalfSpaces& lines() const { return lines_; }

 private:
  // An image with fewer points in it is mostly searched in vain.
  static constexpr int64_t kMaxPixelsPerPoint = 4;
  static constexpr int64_t kTile = 64, kLeafSide = 4;
  static constexpr int64_t kRowsPerPiece = 16;
  static constexpr int64_t kLinesPerPiece = 64;

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

  // The rectangle of pixels that the cloud covers, and where its lines begin.
  bool measure(const pc_context& context, ScratchFrame& scratch, const Grid& grid, int64_t begin, int64_t end) {
    if (begin == end) return false;
    first_row_ = grid.pixel[begin] / grid.width;
    height_ = grid.pixel[end - 1] / grid.width - first_row_ + 1;
    if (height_ > kMaxPixelsPerPoint * (end - begin)) return false;
    int64_t* start = scratch.take<int64_t>(height_ + 1);
    line_start_ = start;
    parallel_for(context, height_ + 1, kLinesPerPiece, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t v = first; v < last; ++v)
        start[v] = std::lower_bound(grid.pixel + (v == first ? begin : start[v - 1]), grid.pixel + end,
                                    (first_row_ + v) * grid.width) -
                   grid.pixel;
    });
    first_column_ = grid.width;
    int64_t last_column = 0;
    for (int64_t v = 0; v < height_; ++v) {
      if (start[v] == start[v + 1]) continue;
      const int64_t line = (first_row_ + v) * grid.width;
      first_column_ = std::min(first_column_, grid.pixel[start[v]] - line);
      last_column = std::max(last_column, grid.pixel[start[v + 1] - 1] - line);
    }
    width_ = last_column - first_column_ + 1;
    return true;
  }

  // Write line v of the image, or one of the margin: points where there are any, infinity elsewhere.
  void lay_line(const float* points, const Grid& grid, int64_t v) {
    const int64_t end = stride_ - max_reach_;
    int64_t next = -max_reach_;  // column to be written
    const auto clear_up_to = [&](int64_t u) {
      for (float* axis : image_) std::fill(axis + v * stride_ + next, axis + v * stride_ + u, kInfinity);
      next = u;
    };
    if (v >= 0 && v < height_) {
      const int64_t line = (first_row_ + v) * grid.width + first_column_, last = line_start_[v + 1];
      for (int64_t i = line_start_[v]; i < last;) {
        const int64_t run = run_of(grid.pixel + i, last - i), u = grid.pixel[i] - line, at = v * stride_ + u;
        clear_up_to(u);
        lay_run(points + 3 * i, run, image_[0] + at, image_[1] + at, image_[2] + at);
        for (int64_t j = 0; j < run; ++j) row_of_pixel_[at + j] = static_cast<uint32_t>(i + j);
        next = u + run;
        i += run;
      }
    }
    clear_up_to(end);
  }
  // How many of so many rising pixels follow one another.
  static int64_t run_of(const int64_t* pixel, int64_t count) {
    int64_t run = 1;
    for (int64_t step = 64; step > 0; step /= 4)
      while (run + step <= count && pixel[run + step - 1] == pixel[0] + run + step - 1) run += step;
    return run;
  }
  static void lay_run(const float* __restrict points, int64_t count, float* __restrict x, float* __restrict y,
                      float* __restrict z) {
    for (int64_t i = 0; i < count; ++i) {
      x[i] = points[3 * i];
      y[i] = points[3 * i + 1];
      z[i] = points[3 * i + 2];
    }
  }

  // Write the image and measure its slopes; false where a point is not in front of the camera.
  bool lay_out(const pc_context& context, ScratchFrame& scratch, const float* points, const Grid& grid) {
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
      const int64_t first = band * kRowsPerPiece, last = std::min(height_, first + kRowsPerPiece);
      for (int64_t v = first; v < last; ++v) {
        lay_line(points, grid, v);
        fine &= slopes_of_line(v, least, most, line[v], line[height_ + v]);
      }
      if (!fine) in_front.store(false, std::memory_order_relaxed);
      for (int64_t margin = 1; margin <= max_reach_; ++margin) {
        if (first == 0) lay_line(points, grid, -margin);
        if (last == height_) lay_line(points, grid, height_ - 1 + margin);
      }
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
    FloatPack low(kInfinity), high(-kInfinity);
    PackMask bad = 0;
    for (int64_t u = 0; u < width_; u += kQueries) {
      const int64_t at = v * stride_ + u;
      FloatPack x = FloatPack::load(image_[0] + at), y = FloatPack::load(image_[1] + at),
                z = FloatPack::load(image_[2] + at);
      const PackMask real = less(z, FloatPack(kInfinity));
      camera_.move(x, y, z);
      const FloatPack inverse = FloatPack(1.0f) / z, across = x * inverse, down = y * inverse;
      // Every comparison is false for NaN, which so counts as bad.
      bad |= real &
             ~(less(FloatPack(math::kLeastDepth), z) & less(z, FloatPack(kInfinity)) & within(across) & within(down));
      minimum(across, FloatPack::load(least + u)).store(least + u);
      maximum(across, FloatPack::load(most + u)).store(most + u);
      low = minimum(down, low);
      high = maximum(down, high);
    }
    line_least = smallest(low);
    line_most = largest(high);
    return bad == 0;
  }
  static PackMask within(const FloatPack& slope) {
    return less(slope, FloatPack(math::kMostSlope)) & less(FloatPack(-math::kMostSlope), slope);
  }

  int64_t first_row_ = 0, first_column_ = 0, width_ = 0, height_ = 0, stride_ = 0, origin_ = 0;
  int max_reach_ = 0;
  const int64_t* line_start_ = nullptr;  // (height + 1,) the first row of each line
  CameraFrame camera_{nullptr};
  float* image_[3] = {};
  uint32_t* row_of_pixel_ = nullptr;
  HalfSpaces columns_{}, lines_{};
};

}  // namespace pc::neighbors
