// An implicit tree of boxes over points in Morton order, exact for every density: no pointers, nothing to tune.
//
// Every 16 consecutive points of a cloud form a leaf, every 16 consecutive nodes a parent, up to one root per cloud.
// Source: Lauterbach et al., Fast BVH construction on GPUs, 2009.
#pragma once

#include "pc/neighbors/leaves.hpp"

namespace pc::neighbors {

constexpr int kFanOut = kQueries;

// The boxes of sixteen siblings; a missing one is at infinity too.
struct alignas(64) Boxes {
  float low[3][kFanOut], high[3][kFanOut];
};

// The tree of one cloud. Boxes i of a level are the children of node i of the level above; level 0 holds the leaves'.
struct CloudTree {
  static constexpr int kMaxLevels = 8;  // 16^8 leaves are more than 2^31 rows can fill
  const Leaf* leaf;
  int64_t num_leaves;
  int num_levels;
  Boxes* level[kMaxLevels];
};

inline void set_box(Boxes& boxes, int64_t slot, const float low[3], const float high[3]) {
  for (int axis = 0; axis < 3; ++axis) {
    boxes.low[axis][slot] = low[axis];
    boxes.high[axis][slot] = high[axis];
  }
}

// body(level, nodes, blocks) for every level of the tree over so many leaves.
template <class Body>
void for_levels(int64_t num_leaves, Body&& body) {
  int64_t nodes = num_leaves;
  for (int level = 0; nodes > 0; ++level) {
    const int64_t blocks = (nodes + kFanOut - 1) / kFanOut;
    body(level, nodes, blocks);
    nodes = blocks > 1 ? blocks : 0;
  }
}

// How many Boxes the trees of all clouds take.
inline int64_t count_boxes(const Leaves& leaves) {
  int64_t total = 0;
  for (int64_t b = 0; b < leaves.num_clouds; ++b)
    for_levels(leaves.leaf_ptr[b + 1] - leaves.leaf_ptr[b], [&](int, int64_t, int64_t blocks) { total += blocks; });
  return total;
}

// The trees of all clouds, whose boxes follow one another in memory: cloud by cloud, from the leaves up.
inline CloudTree* lay_out_trees(ScratchFrame& scratch, const Leaves& leaves, Boxes* boxes) {
  CloudTree* trees = scratch.take<CloudTree>(leaves.num_clouds);
  for (int64_t b = 0; b < leaves.num_clouds; ++b) {
    trees[b] = {leaves.leaf + leaves.leaf_ptr[b], leaves.leaf_ptr[b + 1] - leaves.leaf_ptr[b], 0, {}};
    for_levels(trees[b].num_leaves, [&](int level, int64_t, int64_t blocks) {
      trees[b].level[level] = boxes;
      trees[b].num_levels = level + 1;
      boxes += blocks;
    });
  }
  return trees;
}

// Set the boxes of trees that are laid out.
inline void fill_trees(const pc_context& context, CloudTree* trees, int64_t num_clouds) {
  const float nowhere_low[3] = {kInfinity, kInfinity, kInfinity};
  const float nowhere_high[3] = {-kInfinity, -kInfinity, -kInfinity};
  constexpr int64_t kBlocksPerPiece = 64;
  const auto build_level = [&](const CloudTree& tree, int level, int64_t nodes, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i)
      for (int64_t slot = 0; slot < kFanOut; ++slot) {
        const int64_t node = i * kFanOut + slot;
        if (node >= nodes) {
          set_box(tree.level[level][i], slot, nowhere_low, nowhere_high);
          continue;
        }
        float low[3], high[3];
        if (level == 0) {
          extent(tree.leaf[node].x, low[0], high[0]);
          extent(tree.leaf[node].y, low[1], high[1]);
          extent(tree.leaf[node].z, low[2], high[2]);
        } else {
          const Boxes& below = tree.level[level - 1][node];
          for (int axis = 0; axis < 3; ++axis) {
            low[axis] = *std::min_element(below.low[axis], below.low[axis] + kFanOut);
            high[axis] = *std::max_element(below.high[axis], below.high[axis] + kFanOut);
          }
        }
        set_box(tree.level[level][i], slot, low, high);
      }
  };
  if (num_clouds > 8) {  // enough clouds to keep every thread busy with whole ones
    parallel_for(context, num_clouds, 1, [&](int64_t b, int64_t, int64_t) {
      for_levels(trees[b].num_leaves,
                 [&](int level, int64_t nodes, int64_t blocks) { build_level(trees[b], level, nodes, 0, blocks); });
    });
    return;
  }
  for (int64_t b = 0; b < num_clouds; ++b)
    for_levels(trees[b].num_leaves, [&](int level, int64_t nodes, int64_t blocks) {
      parallel_for(context, blocks, kBlocksPerPiece,
                   [&](int64_t begin, int64_t end, int64_t) { build_level(trees[b], level, nodes, begin, end); });
    });
}

// Put boxes over leaves, all clouds.
inline CloudTree* build_trees(const pc_context& context, ScratchFrame& scratch, const Leaves& leaves) {
  CloudTree* trees = lay_out_trees(scratch, leaves, scratch.take<Boxes>(count_boxes(leaves)));
  fill_trees(context, trees, leaves.num_clouds);
  return trees;
}

}  // namespace pc::neighbors
