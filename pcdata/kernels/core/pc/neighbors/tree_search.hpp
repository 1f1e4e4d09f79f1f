// The search of a box tree for sixteen queries at once.
#pragma once

#include <vector>

#include "pc/neighbors/box_tree.hpp"

namespace pc::neighbors {

// The squared distance that neighbors of a query have at most: one for all, or one for each row of the queries.
struct Limits {
  float all;
  const float* each = nullptr;  // (Q,)

  Limits(float one) : all(one) {}  // implicit: most searches have one
  Limits(float one, const float* many) : all(one), each(many) {}
  float of(uint32_t row) const { return each == nullptr ? all : each[row]; }
};

// Sixteen queries, one per lane.
struct QueryGroup {
  FloatPack x, y, z;
  PackMask active;        // the lanes that count
  float low[3], high[3];  // their box, when they come from a leaf: the tree's search needs it

  // Sixteen points, at infinity where there is none. Those become finite, so that no arithmetic meets NaN.
  QueryGroup(const float* qx, const float* qy, const float* qz)
      : x(finite(qx)), y(finite(qy)), z(finite(qz)), active(less(FloatPack::load(qz), FloatPack(kInfinity))) {}

  explicit QueryGroup(const Leaf& leaf) : QueryGroup(leaf.x, leaf.y, leaf.z) {
    extent(leaf.x, low[0], high[0]);
    extent(leaf.y, low[1], high[1]);
    extent(leaf.z, low[2], high[2]);
  }

  static FloatPack finite(const float* from) {
    return minimum(FloatPack::load(from), FloatPack(std::numeric_limits<float>::max()));
  }
  // The limit of every lane that counts, off in the others.
  FloatPack limits(const Limits& limits, const uint32_t* row) const {
    alignas(64) float value[kQueries];
    for (int lane = 0; lane < kQueries; ++lane) value[lane] = active >> lane & 1 ? limits.of(row[lane]) : kOff;
    return FloatPack::load(value);
  }
};

// Squared gaps between the group's box and sixteen boxes.
inline FloatPack box_gaps(const QueryGroup& queries, const Boxes& boxes) {
  FloatPack gap[3];
  for (int axis = 0; axis < 3; ++axis)
    gap[axis] = maximum(maximum(FloatPack::load(boxes.low[axis]) - FloatPack(queries.high[axis]),
                                FloatPack(queries.low[axis]) - FloatPack::load(boxes.high[axis])),
                        FloatPack(0.0f));
  return squared_length(gap[0], gap[1], gap[2]);
}

// The lanes whose query has less than `reach` between itself and one box.
inline PackMask lanes_near(const QueryGroup& queries, const Boxes& boxes, int64_t slot, const FloatPack& reach) {
  const FloatPack* at[3] = {&queries.x, &queries.y, &queries.z};
  FloatPack gap[3];
  for (int axis = 0; axis < 3; ++axis)
    gap[axis] =
        maximum(maximum(FloatPack(boxes.low[axis][slot]) - *at[axis], *at[axis] - FloatPack(boxes.high[axis][slot])),
                FloatPack(0.0f));
  return less_equal(squared_length(gap[0], gap[1], gap[2]), reach);
}

// Walks up from a leaf to the root; on the way looks into every sibling that is near enough, nearest first. A box is
// passed by only when its computed gap exceeds what is wanted: rounding is monotone and a gap takes the operations of a
// point distance in the same order, so it never exceeds the computed distance of a point inside. No tolerance needed.
class TreeSearch {
 public:
  // Offer to `nearest` all points of the cloud that can matter, from leaf `start` on.
  template <class Nearest>
  void run(const CloudTree& tree, const QueryGroup& queries, int64_t start, Nearest& nearest) {
    tree_ = tree;
    visited_.clear();
    visit(queries, start, nearest);
    int64_t child = start;
    for (int level = 0; level < tree_.num_levels; ++level) {
      descend(queries, level, child / kFanOut, static_cast<int>(child % kFanOut), nearest);
      child /= kFanOut;
    }
  }

  // The leaf reached by always taking the nearest box.
  int64_t leaf_near(const CloudTree& tree, const QueryGroup& queries) const {
    int64_t node = 0;
    for (int level = tree.num_levels - 1; level >= 0; --level) {
      alignas(64) float gap[kFanOut];
      box_gaps(queries, tree.level[level][node]).store(gap);
      node = node * kFanOut + (std::min_element(gap, gap + kFanOut) - gap);
    }
    return node;
  }

  uint32_t row(uint32_t id) const { return id; }
  uint32_t row_in_lane(uint32_t id, int) const { return id; }

  // Show again every point that run() has shown and that lies in a box at most `reach` away from some lane:
  // body(x, y, z, id), where row_in_lane(id, lane) is the point's row.
  template <class Body>
  void replay(const QueryGroup& queries, const FloatPack& reach, Body&& body) const {
    for (const int64_t index : visited_) {
      if (!lanes_near(queries, tree_.level[0][index / kFanOut], index % kFanOut, reach)) continue;
      const Leaf& leaf = tree_.leaf[index];
      for (int i = 0; i < kLeafSize; ++i)
        if (leaf.row[i] != kNoId) body(FloatPack(leaf.x[i]), FloatPack(leaf.y[i]), FloatPack(leaf.z[i]), leaf.row[i]);
    }
  }

 private:
  template <class Nearest>
  void visit(const QueryGroup& queries, int64_t index, Nearest& nearest) {
    visited_.push_back(index);
    const Leaf& leaf = tree_.leaf[index];
    for (int i = 0; i < kLeafSize; ++i) {
      const FloatPack squared = squared_length(FloatPack(leaf.x[i]) - queries.x, FloatPack(leaf.y[i]) - queries.y,
                                               FloatPack(leaf.z[i]) - queries.z);
      if (nearest.wants(squared)) nearest.offer(squared, Ids::same(leaf.row[i]));
    }
    nearest.settle();
  }

  template <class Nearest>
  void descend(const QueryGroup& queries, int level, int64_t block, int skip, Nearest& nearest) {
    const Boxes& boxes = tree_.level[level][block];
    const FloatPack gaps = box_gaps(queries, boxes);
    // A gap of infinity is a missing box, or one too far for any distance in it to fit a float.
    PackMask near = less_equal(gaps, FloatPack(nearest.widest())) & less(gaps, FloatPack(kInfinity));
    if (skip >= 0) near &= ~(PackMask{1} << skip);
    if (near == 0) return;
    Child children[kFanOut];
    const int count = sort_by_gap(gaps, near, children);
    for (int i = 0; i < count; ++i) {
      const int slot = children[i].slot;
      if (!lanes_near(queries, boxes, slot, nearest.bound())) continue;
      const int64_t node = block * kFanOut + slot;
      if (level == 0)
        visit(queries, node, nearest);
      else
        descend(queries, level - 1, node, -1, nearest);
    }
  }

  struct Child {
    float gap;
    int slot;
  };

  static int sort_by_gap(const FloatPack& gaps, PackMask near, Child (&children)[kFanOut]) {
    alignas(64) float gap[kFanOut];
    gaps.store(gap);
    int count = 0;
    for (; near != 0; near &= near - 1) {
      const int slot = __builtin_ctz(near);
      int at = count++;
      for (; at > 0 && children[at - 1].gap > gap[slot]; --at) children[at] = children[at - 1];
      children[at] = {gap[slot], slot};
    }
    return count;
  }

  CloudTree tree_{};
  std::vector<int64_t> visited_;
};

}  // namespace pc::neighbors
