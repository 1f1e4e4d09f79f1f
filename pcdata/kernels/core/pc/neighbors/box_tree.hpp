// An implicit tree of boxes over points in Morton order, exact for every density: no pointers, nothing to tune.
//
// Every 16 consecutive points of a cloud form a leaf, every 16 consecutive nodes a parent, up to one root per cloud.
// Source: Lauterbach et al., Fast BVH construction on GPUs, 2009.
#pragma once

#include "pc/common.hpp"
#include "pc/sixteen.hpp"
#include "pc/sort/morton_rows.hpp"
#include "pc/neighbors/nearest.hpp"

namespace pc {

constexpr int kLeafSize = kQueries;
constexpr int kFanOut = kQueries;

// Sixteen points; empty slots lie at infinity, so their distances need no mask, and have row kNoId.
struct alignas(64) Leaf {
  float x[kLeafSize], y[kLeafSize], z[kLeafSize];
  uint32_t row[kLeafSize];
};

// The boxes of sixteen siblings; a missing one is at infinity too.
struct alignas(64) Boxes {
  float low[3][kFanOut], high[3][kFanOut];
};

// A batch of ragged clouds as leaves: those of cloud b are leaf_ptr[b] to leaf_ptr[b+1].
struct Leaves {
  Leaf* leaf;
  const int64_t* leaf_ptr;  // (B+1)
  int64_t num_clouds;

  int64_t count() const { return leaf_ptr[num_clouds]; }
};

// The tree of one cloud. Boxes i of a level are the children of node i of the level above; level 0 holds the leaves'.
struct CloudTree {
  static constexpr int kMaxLevels = 8;  // 16^8 leaves are more than 2^31 rows can fill
  const Leaf* leaf;
  int64_t num_leaves;
  int num_levels;
  Boxes* level[kMaxLevels];
};

// What a leaf is made of: rows in Morton order, already sorted.
inline void fill_leaf(const float* points, const uint64_t* keys, int64_t count, Leaf& leaf) {
  for (int64_t i = 0; i < kLeafSize; ++i) {
    const bool real = i < count;
    const uint32_t row = real ? MortonSort::row(keys[i]) : kNoId;
    const float* p = points + 3 * int64_t{real ? row : 0};
    leaf.x[i] = real ? p[0] : kInfinity;
    leaf.y[i] = real ? p[1] : kInfinity;
    leaf.z[i] = real ? p[2] : kInfinity;
    leaf.row[i] = row;
  }
}

// Sorts ragged clouds into leaves.
class LeafBuilder {
 public:
  LeafBuilder(const pc_context& context, ScratchFrame& scratch, const float* points, const int64_t* ptr,
              int64_t num_clouds)
      : context_(context), scratch_(scratch), points_(points), ptr_(ptr), num_clouds_(num_clouds) {
    const int64_t count = ptr[num_clouds] - ptr[0];
    keys_ = scratch.take<uint64_t>(count);
    sort(scratch.take<uint64_t>(count));
    all_ = fill(ptr_);
  }

  // Every row, copies included.
  const Leaves& all() const { return all_; }

  // Rows among which a search for the nearest `max_copies` points cannot miss anything. Of consecutive equal points
  // only the `max_copies` lowest rows need stay: under the order (distance, row) no further copy can be among the
  // nearest `max_copies`, and thousands of equal points (zeros left by missing depth) would cost quadratic time.
  // leaf_of_group[g] becomes the leaf in which the first row of all().leaf[g] is, or would be.
  Leaves without_copies(int64_t max_copies, const int64_t*& leaf_of_group) {
    int64_t* place = scratch_.take<int64_t>(all_.count());
    leaf_of_group = place;
    if (!has_copies()) {
      for (int64_t g = 0; g < all_.count(); ++g) place[g] = g;
      return all_;
    }
    const uint64_t* keys = keys_;
    keys_ = scratch_.take<uint64_t>(ptr_[num_clouds_] - ptr_[0]);
    int64_t* kept_ptr = scratch_.take<int64_t>(num_clouds_ + 1);
    int64_t kept = 0, leaves_before = 0;
    Poll poll(context_);
    for (int64_t b = 0; b < num_clouds_; ++b) {
      poll.check();
      kept_ptr[b] = kept;
      int64_t run = 0;  // copies before this one
      for (int64_t i = 0; i < ptr_[b + 1] - ptr_[b]; ++i) {
        const uint64_t* key = keys + (ptr_[b] - ptr_[0]) + i;
        if (i % kLeafSize == 0)
          place[all_.leaf_ptr[b] + i / kLeafSize] =
              leaves_before + std::max<int64_t>(0, kept - kept_ptr[b] - 1) / kLeafSize;
        run = i > 0 && same_place(key[0], key[-1]) ? run + 1 : 0;
        if (run < max_copies) keys_[kept++] = *key;
      }
      leaves_before += (kept - kept_ptr[b] + kLeafSize - 1) / kLeafSize;
    }
    kept_ptr[num_clouds_] = kept;
    return fill(kept_ptr);
  }

 private:
  static constexpr int64_t kLeavesPerPiece = 256;

  bool same_place(uint64_t a, uint64_t b) const {
    const float *p = points_ + 3 * int64_t{MortonSort::row(a)}, *q = points_ + 3 * int64_t{MortonSort::row(b)};
    return p[0] == q[0] && p[1] == q[1] && p[2] == q[2];
  }

  void sort(uint64_t* spare) {
    const MortonSort order(context_, points_);
    int64_t b = 0;
    while (b < num_clouds_) {
      // Small clouds are shared out among threads, large ones are sorted by all threads.
      const int64_t first = b;
      while (b < num_clouds_ && ptr_[b + 1] - ptr_[b] < MortonSort::kParallelFrom) ++b;
      parallel_for(context_, b - first, 1, [&](int64_t i, int64_t, int64_t) {
        const int64_t begin = ptr_[first + i], at = begin - ptr_[0];
        order.sort_small_cloud(begin, ptr_[first + i + 1], keys_ + at, spare + at);
      });
      for (; b < num_clouds_ && ptr_[b + 1] - ptr_[b] >= MortonSort::kParallelFrom; ++b)
        order.sort(ptr_[b], ptr_[b + 1], keys_ + (ptr_[b] - ptr_[0]), spare + (ptr_[b] - ptr_[0]));
    }
  }

  // Cut keys_, the first of which belongs to row ptr[0] of its clouds, into leaves.
  Leaves fill(const int64_t* ptr) {
    int64_t* leaf_ptr = scratch_.take<int64_t>(num_clouds_ + 1);
    leaf_ptr[0] = 0;
    for (int64_t b = 0; b < num_clouds_; ++b)
      leaf_ptr[b + 1] = leaf_ptr[b] + (ptr[b + 1] - ptr[b] + kLeafSize - 1) / kLeafSize;
    Leaf* leaf = scratch_.take<Leaf>(leaf_ptr[num_clouds_]);
    parallel_for(context_, leaf_ptr[num_clouds_], kLeavesPerPiece, [&](int64_t begin, int64_t end, int64_t) {
      int64_t b = std::upper_bound(leaf_ptr, leaf_ptr + num_clouds_ + 1, begin) - leaf_ptr - 1;
      for (int64_t i = begin; i < end; ++i) {
        while (i >= leaf_ptr[b + 1]) ++b;
        const int64_t first = ptr[b] + (i - leaf_ptr[b]) * kLeafSize;
        fill_leaf(points_, keys_ + (first - ptr[0]), std::min<int64_t>(kLeafSize, ptr[b + 1] - first), leaf[i]);
      }
    });
    return {leaf, leaf_ptr, num_clouds_};
  }

  // Whether dropping pays: a run of copies so long that it fills a leaf.
  bool has_copies() const {
    std::atomic<bool> found{false};
    parallel_for(context_, all_.count(), kLeavesPerPiece, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i)
        if (is_one_place(all_.leaf[i])) found.store(true, std::memory_order_relaxed);
    });
    return found.load();
  }

  static bool is_one_place(const Leaf& leaf) {
    for (int i = 1; i < kLeafSize; ++i)
      if (leaf.x[i] != leaf.x[0] || leaf.y[i] != leaf.y[0] || leaf.z[i] != leaf.z[0]) return false;
    return true;
  }

  const pc_context& context_;
  ScratchFrame& scratch_;
  const float* points_;
  const int64_t* ptr_;
  int64_t num_clouds_;
  uint64_t* keys_ = nullptr;  // rows in order
  Leaves all_{};
};

inline void set_box(Boxes& boxes, int64_t slot, const float low[3], const float high[3]) {
  for (int axis = 0; axis < 3; ++axis) {
    boxes.low[axis][slot] = low[axis];
    boxes.high[axis][slot] = high[axis];
  }
}

// The box of one axis of a leaf; points at infinity are no points.
inline void extent(const float (&value)[kLeafSize], float& low, float& high) {
  low = kInfinity;
  high = -kInfinity;
  for (int i = 0; i < kLeafSize; ++i) {
    low = value[i] < low ? value[i] : low;
    const float finite = value[i] == kInfinity ? -kInfinity : value[i];
    high = finite > high ? finite : high;
  }
}

// Put boxes over leaves, all clouds.
inline CloudTree* build_trees(const pc_context& context, ScratchFrame& scratch, const Leaves& leaves) {
  CloudTree* trees = scratch.take<CloudTree>(leaves.num_clouds);
  int64_t total = 0;
  const auto for_levels = [&](int64_t cloud, auto&& body) {
    int64_t nodes = leaves.leaf_ptr[cloud + 1] - leaves.leaf_ptr[cloud];
    for (int level = 0; nodes > 0; ++level) {
      const int64_t blocks = (nodes + kFanOut - 1) / kFanOut;
      body(level, nodes, blocks);
      nodes = blocks > 1 ? blocks : 0;
    }
  };
  for (int64_t b = 0; b < leaves.num_clouds; ++b)
    for_levels(b, [&](int, int64_t, int64_t blocks) { total += blocks; });
  Boxes* boxes = scratch.take<Boxes>(total);
  int64_t used = 0;
  for (int64_t b = 0; b < leaves.num_clouds; ++b) {
    trees[b] = {leaves.leaf + leaves.leaf_ptr[b], leaves.leaf_ptr[b + 1] - leaves.leaf_ptr[b], 0, {}};
    for_levels(b, [&](int level, int64_t, int64_t blocks) {
      trees[b].level[level] = boxes + used;
      trees[b].num_levels = level + 1;
      used += blocks;
    });
  }
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
  if (leaves.num_clouds > 8) {  // enough clouds to keep every thread busy with whole ones
    parallel_for(context, leaves.num_clouds, 1, [&](int64_t b, int64_t, int64_t) {
      for_levels(b, [&](int level, int64_t nodes, int64_t blocks) { build_level(trees[b], level, nodes, 0, blocks); });
    });
    return trees;
  }
  for (int64_t b = 0; b < leaves.num_clouds; ++b)
    for_levels(b, [&](int level, int64_t nodes, int64_t blocks) {
      parallel_for(context, blocks, kBlocksPerPiece, [&](int64_t begin, int64_t end, int64_t) {
        build_level(trees[b], level, nodes, begin, end);
      });
    });
  return trees;
}

}  // namespace pc
