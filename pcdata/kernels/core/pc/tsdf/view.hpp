// One view of a truncated signed distance field, and which pixels and voxels of a block can meet.
#pragma once

#include <algorithm>
#include <limits>

#include "pc/simd.hpp"
#include "pc/tsdf/grid.hpp"

namespace pc::tsdf {

constexpr int kGroups = kVoxels / kLanes;  // of voxels updated together

// Where two registers can be permuted as one, pixels of small windows are found in registers instead of in memory.
#if defined(PC_AVX512)
constexpr bool kHasTables = true;
#else
constexpr bool kHasTables = false;
#endif
constexpr int kSmallestTable = 64, kLargestTable = 256;  // pixels

struct FusedView {
  const float* depth;     // (height, width)
  const int32_t* weight;  // the same; null = 1 everywhere
  const int32_t* color;   // r | g << 10 | b << 20, in steps of a stored color, or null
  const int32_t* label;   // or null
  int64_t height, width;
  const double* pose;  // (3, 4) image from world: pixel and depth, but the camera's frame where there is a lens
  double block_size;
  const float* steps;    // (3, 512): the voxels of a block from its first one, likewise
  const float* pinhole;  // fx, skew, cx, fy, cy
  const float* lens;     // 12 coefficients and the squared radius where the model folds, or null
  float scale;           // of a stored distance, per metre
  bool carve;
};

typedef float Corners __attribute__((vector_size(32)));  // one number for each corner of a block

inline float lowest(const Corners& x) {
  return reduce<float>(x, [](const auto& a, const auto& b) { return minimum(a, b); });
}
inline float highest(const Corners& x) {
  return reduce<float>(x, [](const auto& a, const auto& b) { return maximum(a, b); });
}

// A block as a view sees it.
struct ProjectedBlock {
  int64_t row;
  float first[3];                        // its first voxel, as FusedView::pose maps it
  bool inside;                           // every voxel falls on a pixel, further away than no reading (0) could be near
  int32_t entries;                       // of the table that holds these pixels; 0 where they are too many for one
  int32_t u, v;                          // the first pixel of the table
  int32_t shift;                         // rows of the table are 1 << shift pixels apart
  uint32_t groups[(kGroups + 31) / 32];  // those that may hold a voxel to update

  bool any() const {
    uint32_t all = 0;
    for (const uint32_t word : groups) all |= word;
    return all != 0;
  }
  void clear() {
    for (uint32_t& word : groups) word = 0;
  }
};

// What all blocks of a view share.
class BlockProjector {
 public:
  explicit BlockProjector(const FusedView& view) : view_(view) {
    constexpr int across = kEdge - 1, last[3] = {across, across * kEdge, across * kEdge * kEdge};
    for (int i = 0; i < 8; ++i)
      for (int a = 0; a < 3; ++a)
        corners_[a][i] = view.steps[a * kVoxels + (i & 1) * last[0] + (i >> 1 & 1) * last[1] + (i >> 2) * last[2]];
    for (int g = 0; g < kGroups; ++g) {
      const float* z = view.steps + 2 * kVoxels + g * kLanes;
      low_[g] = *std::min_element(z, z + kLanes);
      high_[g] = *std::max_element(z, z + kLanes);
    }
  }

  // Nothing is missed: a group that is left out has no voxel that the view updates.
  ProjectedBlock of(int64_t key, int64_t row) const {
    ProjectedBlock seen;
    seen.row = row;
    place(key, seen.first);
    seen.inside = false;
    seen.entries = 0;
    constexpr float everything = std::numeric_limits<float>::infinity();
    DepthRange range{-everything, everything};
    if (view_.lens == nullptr) range = look(seen);
    mark(range, seen);
    return seen;
  }

 private:
  struct DepthRange {
    float low, high;
  };
  static constexpr DepthRange kNothing{1, -1};

  void place(int64_t key, float* first) const {
    const BlockPlace block = BlockPlace::of(key);
    const double bx = static_cast<double>(block.x) * view_.block_size;
    const double by = static_cast<double>(block.y) * view_.block_size;
    const double bz = static_cast<double>(block.z) * view_.block_size;
    for (int a = 0; a < 3; ++a) {
      const double* m = view_.pose + 4 * a;
      first[a] = static_cast<float>(((m[0] * bx + m[1] * by) + m[2] * bz) + m[3]);
    }
  }

  // The depths at which voxels of a block may be updated. The pixels of a block are those between its corners';
  // rounding moves them by less than the margin as long as the block is not much deeper than it is near.
  DepthRange look(ProjectedBlock& seen) const {
    constexpr float margin = 1.0f / 16, everything = std::numeric_limits<float>::infinity();
    constexpr int64_t widest = int64_t{1} << 15;
    const Corners z = seen.first[2] + corners_[2];
    const float nearest = lowest(z), furthest = highest(z);
    if (!(furthest > 0)) return kNothing;
    if (!(nearest > 0.25f * furthest)) return {-everything, everything};
    if (view_.width > widest || view_.height > widest) return {-everything, everything};
    const Corners inverse = 1.0f / z;
    const Corners u = (seen.first[0] + corners_[0]) * inverse, v = (seen.first[1] + corners_[1]) * inverse;
    const float left = lowest(u) - margin, right = highest(u) + margin;
    const float top = lowest(v) - margin, bottom = highest(v) + margin;
    const auto width = static_cast<float>(view_.width), height = static_cast<float>(view_.height);
    if (!(left < width && right >= 0 && top < height && bottom >= 0)) return kNothing;
    const bool on_pixels = left >= 0 && right < width && top >= 0 && bottom < height;
    seen.inside = on_pixels && nearest > truncation();
    const auto first_u = static_cast<int32_t>(std::max(left, 0.0f));
    const auto first_v = static_cast<int32_t>(std::max(top, 0.0f));
    const auto last_u = static_cast<int32_t>(std::min(right, width - 1));
    const auto last_v = static_cast<int32_t>(std::min(bottom, height - 1));
    if (kHasTables && seen.inside) choose_table(first_u, last_u, first_v, last_v, seen);
    return widened(readings(first_u, last_u, first_v, last_v));
  }

  // The smallest table that holds a window, moved inwards at the borders of the image.
  void choose_table(int32_t first_u, int32_t last_u, int32_t first_v, int32_t last_v, ProjectedBlock& seen) const {
    for (int32_t entries = kSmallestTable; entries <= kLargestTable; entries *= 2)
      for (int32_t shift = 3; shift <= 4; ++shift) {
        const int32_t width = 1 << shift, height = entries >> shift;
        const int32_t u = std::min(first_u, static_cast<int32_t>(view_.width) - width);
        const int32_t v = std::min(first_v, static_cast<int32_t>(view_.height) - height);
        if (u < 0 || v < 0 || last_u - u >= width || last_v - v >= height) continue;
        seen.entries = entries;
        seen.shift = shift;
        seen.u = u;
        seen.v = v;
        return;
      }
  }

  // The range of the readings in some pixels; it may take more pixels in.
  DepthRange readings(int32_t first_u, int32_t last_u, int32_t first_v, int32_t last_v) const {
    constexpr float everything = std::numeric_limits<float>::infinity();
    constexpr int32_t most = 64;  // pixels each way: looking at more costs more than it saves
    const int64_t pixels = view_.width * view_.height;
    if (last_u - first_u >= most || last_v - first_v >= most || pixels < kLanes) return {0, everything};
    const FloatRegister none = FloatRegister{} + everything;
    FloatRegister low = none, high = {};
    for (int64_t v = first_v; v <= last_v; ++v)
      for (int64_t u = first_u; u <= last_u; u += kLanes) {
        const auto depth = load<FloatRegister>(view_.depth + std::min(v * view_.width + u, pixels - kLanes));
        const RegisterMask read = less(FloatRegister{}, depth);
        high = maximum(depth, high);
        low = minimum(low, select(read, depth, none));
      }
    return {lowest_lane<float>(low), highest_lane<float>(high)};
  }

  float truncation() const { return kTsdfScale / view_.scale * 1.00001f; }

  // By the truncation, and a little more than rounding may cost.
  DepthRange widened(DepthRange depth) const {
    if (!(depth.high > 0)) return kNothing;
    const float low = view_.carve ? 0 : depth.low - depth.low * 1e-6f - truncation();
    return {low, depth.high + depth.high * 1e-6f + truncation()};
  }

  void mark(DepthRange range, ProjectedBlock& seen) const {
    seen.clear();
    const FloatRegister zero = {};
    if (range.low > range.high) return;
    for (int g = 0; g < kGroups; g += kLanes) {
      const FloatRegister low = seen.first[2] + load<FloatRegister>(low_ + g);
      const FloatRegister high = seen.first[2] + load<FloatRegister>(high_ + g);
      const RegisterMask near =
          less_equal(low, zero + range.high) & less_equal(zero + range.low, high) & less(zero, high);
      seen.groups[g / 32] |= near.bits() << g % 32;
    }
  }

  const FusedView& view_;
  Corners corners_[3];
  float low_[kGroups], high_[kGroups];
};

}  // namespace pc::tsdf
