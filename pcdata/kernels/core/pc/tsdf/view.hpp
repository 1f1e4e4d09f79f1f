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

// Some of the groups of a block.
struct GroupSet {
  static constexpr int kWords = (kGroups + 31) / 32;
  uint32_t words[kWords] = {};
};

// Some pixels of an image, both ends within.
struct PixelWindow {
  int32_t first_u = 0, last_u = -1, first_v = 0, last_v = -1;

  int32_t width() const { return last_u - first_u + 1; }
  int32_t height() const { return last_v - first_v + 1; }
};

struct DepthRange {
  float low, high;

  bool is_empty() const { return low > high; }
};

// A block as a view sees it.
struct ProjectedBlock {
  int64_t row;
  float first[3];      // its first voxel, as FusedView::pose maps it
  bool inside;         // every voxel falls on a pixel, further away than no reading (0) could be near
  PixelWindow window;  // the pixels that voxels may fall on; empty where that is not known
  int32_t entries;     // of the table that holds these pixels; 0 where they are too many for one
  int32_t u, v;        // the first pixel of the table
  int32_t shift;       // rows of the table are 1 << shift pixels apart
  DepthRange depths;   // of voxels that may be updated
  GroupSet groups;     // those that may hold a voxel to update
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

  // Where a block is seen. Its pixels are sent for; `judge` looks at them, best some time later.
  ProjectedBlock aim(int64_t key, int64_t row) const {
    ProjectedBlock seen;
    seen.row = row;
    place(key, seen.first);
    seen.inside = false;
    seen.entries = 0;
    seen.depths = view_.lens == nullptr ? aim_at_pixels(seen) : kEverything;
    return seen;
  }

  // Tell the groups that may hold a voxel to update. Nothing is missed: one that is left out has none.
  void judge(ProjectedBlock& seen) const {
    if (seen.window.height() > 0) seen.depths = widened(readings(seen.window));
    seen.groups = groups_within(seen.depths, seen);
  }

 private:
  static constexpr DepthRange kNothing{1, -1};
  static constexpr DepthRange kEverything{-std::numeric_limits<float>::infinity(),
                                          std::numeric_limits<float>::infinity()};
  static constexpr int32_t kMostPixels = 64;  // each way: looking at more costs more than it saves

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

  // The depths at which voxels may be updated as far as that is known without looking at the pixels. The pixels of a
  // block are those between its corners'; rounding moves them by less than the margin as long as the block is not much
  // deeper than it is near.
  DepthRange aim_at_pixels(ProjectedBlock& seen) const {
    constexpr float margin = 1.0f / 16;
    constexpr int64_t widest = int64_t{1} << 15;
    const Corners z = seen.first[2] + corners_[2];
    const float nearest = lowest(z), furthest = highest(z);
    if (!(furthest > 0)) return kNothing;
    if (!(nearest > 0.25f * furthest)) return kEverything;
    if (view_.width > widest || view_.height > widest) return kEverything;
    const Corners inverse = 1.0f / z;
    const Corners u = (seen.first[0] + corners_[0]) * inverse, v = (seen.first[1] + corners_[1]) * inverse;
    const float left = lowest(u) - margin, right = highest(u) + margin;
    const float top = lowest(v) - margin, bottom = highest(v) + margin;
    const auto width = static_cast<float>(view_.width), height = static_cast<float>(view_.height);
    if (!(left < width && right >= 0 && top < height && bottom >= 0)) return kNothing;
    const bool on_pixels = left >= 0 && right < width && top >= 0 && bottom < height;
    seen.inside = on_pixels && nearest > truncation();
    const PixelWindow window{
        static_cast<int32_t>(std::max(left, 0.0f)), static_cast<int32_t>(std::min(right, width - 1)),
        static_cast<int32_t>(std::max(top, 0.0f)), static_cast<int32_t>(std::min(bottom, height - 1))};
    if (kHasTables && seen.inside) choose_table(window, seen);
    const bool are_few = window.width() <= kMostPixels && window.height() <= kMostPixels;
    if (!are_few || view_.width * view_.height < kLanes) return {view_.carve ? 0 : -truncation(), kEverything.high};
    seen.window = window;
    send_for(window);
    return kEverything;
  }

  void send_for(const PixelWindow& window) const {
    for (int64_t v = window.first_v; v <= window.last_v; ++v) {
      const int64_t row = v * view_.width;
      __builtin_prefetch(view_.depth + row + window.first_u);
      __builtin_prefetch(view_.depth + row + window.last_u);
      if (view_.color == nullptr) continue;
      __builtin_prefetch(view_.color + row + window.first_u);
      __builtin_prefetch(view_.color + row + window.last_u);
    }
  }

  // The smallest table that holds a window, moved inwards at the borders of the image.
  void choose_table(const PixelWindow& window, ProjectedBlock& seen) const {
    for (int32_t entries = kSmallestTable; entries <= kLargestTable; entries *= 2)
      for (int32_t shift = 3; shift <= 4; ++shift) {
        const int32_t width = 1 << shift, height = entries >> shift;
        const int32_t u = std::min(window.first_u, static_cast<int32_t>(view_.width) - width);
        const int32_t v = std::min(window.first_v, static_cast<int32_t>(view_.height) - height);
        if (u < 0 || v < 0 || window.last_u - u >= width || window.last_v - v >= height) continue;
        seen.entries = entries;
        seen.shift = shift;
        seen.u = u;
        seen.v = v;
        return;
      }
  }

  // The range of the readings in some pixels; it may take more pixels in.
  DepthRange readings(const PixelWindow& window) const {
    const int64_t pixels = view_.width * view_.height;
    const FloatRegister none = FloatRegister{} + kEverything.high;
    FloatRegister low = none, high = {};
    for (int64_t v = window.first_v; v <= window.last_v; ++v)
      for (int64_t u = window.first_u; u <= window.last_u; u += kLanes) {
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

  GroupSet groups_within(DepthRange range, const ProjectedBlock& seen) const {
    GroupSet found;
    const FloatRegister zero = {};
    if (range.is_empty()) return found;
    for (int g = 0; g < kGroups; g += kLanes) {
      const FloatRegister low = seen.first[2] + load<FloatRegister>(low_ + g);
      const FloatRegister high = seen.first[2] + load<FloatRegister>(high_ + g);
      const RegisterMask near =
          less_equal(low, zero + range.high) & less_equal(zero + range.low, high) & less(zero, high);
      found.words[g / 32] |= near.bits() << g % 32;
    }
    return found;
  }

  const FusedView& view_;
  Corners corners_[3];
  float low_[kGroups], high_[kGroups];
};

}  // namespace pc::tsdf
