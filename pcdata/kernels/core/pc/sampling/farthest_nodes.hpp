// The nodes of the tree that farthest points are found in: leaves of points, and groups of boxes over them.
//
// Points in spatial order are cut into leaves of 32, leaves into groups of 16, groups into groups of 16, and so on: an
// implicit tree without pointers. Every node knows its box, and its farthest point as one number, the key: the bits of
// the squared distance to the nearest pick (they sort like the distance), then the complement of the row, so that the
// larger key is the farther point and, among equals, the lower row.
//
// A pick can only change a point nearer to it than that point's distance so far. The distance from the pick to a box
// is computed with the float operations of the point distance, in the same order; rounding is monotonic, so it is never
// above the distance of a point in the box, and skipping a box that is not nearer than its farthest point is exact.
#pragma once

#include <algorithm>
#include <cstring>

#include "pc/simd.hpp"

namespace pc::sampling {

constexpr int kLeaf = 32;  // points: two AVX-512 registers; 20 bytes a point, and 1.2 more for the nodes
constexpr int kFan = 16;   // children tested at once

constexpr int32_t kTaken = -1;                                       // below the bits of every distance
constexpr int32_t kUnseen = 0x7F800000;                              // infinity
constexpr int64_t kAllTaken = int64_t{kTaken} * (int64_t{1} << 32);  // the key of a leaf without other points

// A point that was taken.
struct Pick {
  float x, y, z;
  uint32_t row;
  int64_t key;  // of the leaf and of every node above the pick
};

struct alignas(64) Leaf {
  float x[kLeaf], y[kLeaf], z[kLeaf];
  int32_t nearest[kLeaf];  // bits of the squared distance to the nearest pick, or kTaken
  uint32_t row[kLeaf];

  // Take note of a pick, which is one of the leaf's own or not; return the key of the leaf's farthest point.
  [[gnu::always_inline]] int64_t update(const Pick& pick, bool is_own) {
    if (is_own) mark_taken(pick.row);
    Int32Register far{};
    for (int i = 0; i < kLeaf; i += kLanes) {
      const FloatRegister squared =
          squared_length(load<FloatRegister>(x + i) - pick.x, load<FloatRegister>(y + i) - pick.y,
                         load<FloatRegister>(z + i) - pick.z);
      // Distances are not negative, so their bits compare as they do.
      const Int32Register own = minimum(reinterpret_cast<Int32Register>(squared), load<Int32Register>(nearest + i));
      store(nearest + i, own);
      far = i == 0 ? own : maximum(far, own);
    }
    const int32_t farthest = highest_lane<int32_t>(far);
    if (farthest == kTaken) return kAllTaken;
    uint32_t those = 0;
    for (int i = 0; i < kLeaf; i += kLanes)
      those |= equal(load<Int32Register>(nearest + i), Int32Register{} + farthest).bits() << i;
    uint32_t lowest = row[__builtin_ctz(those)];
    for (those &= those - 1; those != 0; those &= those - 1) lowest = std::min(lowest, row[__builtin_ctz(those)]);
    return int64_t{farthest} * (int64_t{1} << 32) + static_cast<uint32_t>(~lowest);
  }

 private:
  [[gnu::noinline]] void mark_taken(uint32_t picked) {
    for (int i = 0; i < kLeaf; ++i)
      if (row[i] == picked) nearest[i] = kTaken;
  }
};

inline float float_of_bits(int32_t bits) {
  float value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

// The boxes and keys of 16 nodes.
struct alignas(64) Group {
  float low[3][kFan], high[3][kFan];
  float bound[kFan];  // squared distance of the farthest point
  int64_t key[kFan];

  void set_key(int child, int64_t value) {
    key[child] = value;
    bound[child] = float_of_bits(static_cast<int32_t>(value >> 32));  // NaN or -0 of taken points: nothing is nearer
  }
  void set_unreachable(int child) {
    for (int axis = 0; axis < 3; ++axis) low[axis][child] = high[axis][child] = 0;
    set_key(child, INT64_MIN);
  }
  void enclose(int child, const Group& below) {
    for (int axis = 0; axis < 3; ++axis) {
      low[axis][child] = below.low[axis][0];
      high[axis][child] = below.high[axis][0];
      for (int i = 1; i < kFan && below.key[i] != INT64_MIN; ++i) {
        low[axis][child] = std::min(low[axis][child], below.low[axis][i]);
        high[axis][child] = std::max(high[axis][child], below.high[axis][i]);
      }
    }
    set_key(child, below.farthest());
  }
  int64_t farthest() const {
    auto best = load<Int64Register>(key);
    for (int i = kLanes / 2; i < kFan; i += kLanes / 2) best = maximum(load<Int64Register>(key + i), best);
    return highest_lane<int64_t>(best);
  }

  // The same of all but some children.
  int64_t farthest_beside(uint32_t children) const {
    Int64Register bit, best = Int64Register{} + INT64_MIN;
    for (int i = 0; i < kLanes / 2; ++i) bit[i] = int64_t{1} << i;
    for (int i = 0; i < kFan; i += kLanes / 2) {
      const Int64Register is_one = (Int64Register{} + int64_t{children >> i}) & bit;
      best = maximum(is_one != 0 ? best : load<Int64Register>(key + i), best);
    }
    return highest_lane<int64_t>(best);
  }

  // The children that a pick may change, as a bit mask: boxes nearer than their farthest point. Once only duplicates
  // of picks are left, a pick changes nothing but itself.
  uint32_t reached(const Pick& pick) const {
    if (pick.key >> 32 == 0) return holding(pick);
    uint32_t mask = 0;
    for (int i = 0; i < kFan; i += kLanes) {
      const FloatRegister dx = gap(0, i, pick.x), dy = gap(1, i, pick.y), dz = gap(2, i, pick.z);
      mask |= less(squared_length(dx, dy, dz), load<FloatRegister>(bound + i)).bits() << i;
    }
    return mask;
  }
  uint32_t holding(const Pick& pick) const { return 1u << (std::find(key, key + kFan, pick.key) - key); }
  FloatRegister gap(int axis, int i, float at) const {
    const FloatRegister outside =
        maximum(load<FloatRegister>(low[axis] + i) - at, at - load<FloatRegister>(high[axis] + i));
    return maximum(outside, FloatRegister{});
  }
};

}  // namespace pc::sampling
