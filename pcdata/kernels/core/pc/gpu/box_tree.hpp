// A tree of boxes over points in Morton order, for searches by warps: 32 consecutive points make a leaf, 32 consecutive
// nodes a parent, up to a level of at most 32 nodes. Nothing to tune, no pointers, exact for every density.
//
// Points are sorted by cloud first, so that cloud b is places ptr[b] to ptr[b+1] of the order as it was of the rows.
// Leaves may hold points of two clouds; a search keeps to the places of its own.
//
// Source: Lauterbach et al., Fast BVH construction on GPUs, 2009.
#pragma once

#include "pc/gpu/rows.hpp"
#include "pc/math/bounds.hpp"
#include "pc/math/morton.hpp"

namespace pc::gpu {

constexpr int kFan = PC_WARP, kFanBits = 5;

PC_HD uint64_t morton_bits(float value, float low, float high, int64_t bits) {
  const double most = static_cast<double>(int64_t{1} << bits) - 1;
  const double range = static_cast<double>(high) - static_cast<double>(low);
  const double part = range > 0 ? (static_cast<double>(value) - static_cast<double>(low)) / range * most : 0;
  return static_cast<uint64_t>(part > 0 ? (part < most ? part : most) : 0);  // queries may lie outside
}

// Where rows come in the order: the cloud, then the Morton code in the box of all points; last what no cloud fills.
// `box` is (2, 3); `bits` per axis, 21 at most.
PC_KERNEL(pc_morton_keys, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows, const float* box,
          int64_t bits, int64_t* keys) {
  const int64_t row = thread_index();
  if (row >= rows) return;
  if (row >= ptr[clouds]) {
    keys[row] = 0x7FFFFFFFFFFFFFFF;
    return;
  }
  uint64_t at[3];
  for (int axis = 0; axis < 3; ++axis) at[axis] = morton_bits(points[3 * row + axis], box[axis], box[3 + axis], bits);
  const uint64_t code = math::morton_code(at[0] >> 11, at[1] >> 11, at[2] >> 11) << 33 |
                        math::morton_code(at[0] & 2047, at[1] & 2047, at[2] & 2047);
  keys[row] = cloud_of(ptr, clouds, row) << (3 * bits) | static_cast<int64_t>(code);
}

// Boxes of nodes, and the lowest row in each; the arrays of one level follow those of the level below.
struct Boxes {
  float* sides;   // (6, count): low x, y, z, high x, y, z
  int32_t* rows;  // (count)
  int64_t count;

  PC_HD math::Bounds box(int64_t node) const {
    return {{sides[node], sides[count + node], sides[2 * count + node]},
            {sides[3 * count + node], sides[4 * count + node], sides[5 * count + node]}};
  }
  PC_HD void set(int64_t node, const math::Bounds& box, int32_t row) const {
    for (int axis = 0; axis < 3; ++axis) {
      sides[axis * count + node] = box.low[axis];
      sides[(3 + axis) * count + node] = box.high[axis];
    }
    rows[node] = row;
  }
};

// Lay points out in their order.
PC_KERNEL(pc_place_in_order, const float* points, const int64_t* order, int64_t rows, float* placed) {
  const int64_t i = thread_index();
  if (i >= rows) return;
  const float* p = points + 3 * order[i];
  reinterpret_cast<Placed*>(placed)[i] = {p[0], p[1], p[2], static_cast<int32_t>(order[i])};
}

// The boxes of leaves, which are nodes 0 to `leaves`.
PC_KERNEL(pc_box_leaves, const float* placed, int64_t rows, int64_t leaves, float* sides, int32_t* least_rows,
          int64_t count) {
  const int64_t leaf = thread_index();
  if (leaf >= leaves) return;
  const Placed* points = reinterpret_cast<const Placed*>(placed);
  const int64_t begin = leaf * kFan, end = begin + kFan < rows ? begin + kFan : rows;
  const float origin[3] = {points[begin].x, points[begin].y, points[begin].z};
  math::Bounds box = math::Bounds::of_point(origin);
  int32_t least = points[begin].row;
  for (int64_t i = begin + 1; i < end; ++i) {
    const float point[3] = {points[i].x, points[i].y, points[i].z};
    box.include(point);
    least = points[i].row < least ? points[i].row : least;
  }
  Boxes{sides, least_rows, count}.set(leaf, box, least);
}

// The boxes of one level, nodes `first` to `first + nodes`, over those of the level below, from `below` to `first`.
PC_KERNEL(pc_box_parents, int64_t first, int64_t nodes, int64_t below, float* sides, int32_t* least_rows,
          int64_t count) {
  const int64_t node = thread_index();
  if (node >= nodes) return;
  const Boxes boxes{sides, least_rows, count};
  const int64_t begin = below + node * kFan, end = begin + kFan < first ? begin + kFan : first;
  math::Bounds box = boxes.box(begin);
  int32_t least = least_rows[begin];
  for (int64_t i = begin + 1; i < end; ++i) {
    box.include(boxes.box(i));
    least = least_rows[i] < least ? least_rows[i] : least;
  }
  boxes.set(first + node, box, least);
}

}  // namespace pc::gpu
