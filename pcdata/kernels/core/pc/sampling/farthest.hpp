// Exact farthest point sampling that visits only the points a pick can change.
#pragma once

#include <algorithm>
#include <vector>

#include "pc/memory.hpp"
#include "pc/sampling/farthest_nodes.hpp"
#include "pc/sort/morton_points.hpp"

namespace pc::sampling {

// Samples one cloud by the tree of pc/sampling/farthest_nodes.hpp.
class FarthestSampler {
 public:
  static constexpr int kSideBySide = 8;  // a part of a leaf

  FarthestSampler(ScratchFrame& scratch, const float* points, int64_t count)
      : points_(points), count_(count), num_leaves_((count + kLeaf - 1) / kLeaf) {
    require_numbered(count);
    leaves_ = scratch.take<Leaf>(num_leaves_);
    for (int64_t children = num_leaves_; levels_.empty() || children > 1;) {
      children = (children + kFan - 1) / kFan;
      levels_.push_back({scratch.take<Group>(children), children});
    }
  }

  const float* points() const { return points_; }
  int64_t count() const { return count_; }
  int64_t num_leaf_groups() const { return levels_[0].count; }

  // Where sort::MortonPoints puts its points.
  void place(const sort::PlacedPoint* points, int64_t count, int64_t at) {
    while (count > 0) {
      Leaf& leaf = leaves_[at / kLeaf];
      const int64_t first = at % kLeaf, some = std::min(count, kLeaf - first);
      float *x = leaf.x + first, *y = leaf.y + first, *z = leaf.z + first;
      uint32_t* row = leaf.row + first;
      for (int64_t i = 0; i < some; ++i) {
        x[i] = points[i].x();
        y[i] = points[i].y();
        z[i] = points[i].z();
        row[i] = points[i].row();
      }
      points += some;
      count -= some;
      at += some;
    }
  }

  // Put a point of the cloud at a place.
  void place_one(int64_t row, int64_t at) {
    Leaf& leaf = leaves_[at / kLeaf];
    const float* from = points_ + 3 * row;
    leaf.x[at % kLeaf] = from[0];
    leaf.y[at % kLeaf] = from[1];
    leaf.z[at % kLeaf] = from[2];
    leaf.row[at % kLeaf] = static_cast<uint32_t>(row);
  }

  // Put eight points of the cloud that follow each other at a place, a multiple of eight.
  void place_eight(int64_t first, int64_t at) {
    using sort::Float4;
    Leaf& leaf = leaves_[at / kLeaf];
    const int64_t to = at % kLeaf;
    for (int64_t i = 0; i < kSideBySide; i += 4) {
      const float* from = points_ + 3 * (first + i);
      const auto a = load<Float4>(from), b = load<Float4>(from + 4), c = load<Float4>(from + 8);
      // From two at a time, which compilers know as one instruction.
      const Float4 x{a[0], a[3], b[2], b[2]}, y{a[1], b[0], b[3], b[3]}, z{a[2], b[1], b[1], b[1]};
      store(leaf.x + to + i, Float4{x[0], x[1], x[2], c[1]});
      store(leaf.y + to + i, Float4{y[0], y[1], y[2], c[2]});
      store(leaf.z + to + i, Float4{z[0], z[1], c[0], c[3]});
    }
    for (int i = 0; i < kSideBySide; ++i) leaf.row[to + i] = static_cast<uint32_t>(first) + static_cast<uint32_t>(i);
  }

  // Once all points are placed: measure the leaves of some groups and take row 0 as the first pick. Groups are
  // independent of one another.
  void start_leaf_groups(int64_t begin, int64_t end) {
    const Pick first = pick_of(0);
    for (int64_t group = begin; group < end; ++group) {
      for (int child = 0; child < kFan; ++child) {
        const int64_t index = group * kFan + child;
        if (index < num_leaves_)
          start_leaf(levels_[0].groups[group], child, index, first);
        else
          levels_[0].groups[group].set_unreachable(child);
      }
    }
  }
  // Once that is done for all.
  void start_levels() {
    for (size_t level = 1; level < levels_.size(); ++level) {
      const Level& below = levels_[level - 1];
      for (int64_t group = 0; group < levels_[level].count; ++group) {
        for (int child = 0; child < kFan; ++child) {
          const int64_t index = group * kFan + child;
          if (index < below.count)
            levels_[level].groups[group].enclose(child, below.groups[index]);
          else
            levels_[level].groups[group].set_unreachable(child);
        }
      }
    }
  }

  // Write further picks (rows), until `wanted` are taken or the work is worth `budget` leaves; return how many there
  // are now. Call it again to go on.
  int64_t advance(int64_t* picks, int64_t taken, int64_t wanted, int64_t budget) {
    int64_t next = levels_.back().groups[0].farthest();
    if (taken == 0) picks[taken++] = 0;
    while (taken < wanted && budget > 0) {
      const Pick pick = pick_of(next);
      picks[taken++] = pick.row;
      next = visit(levels_.size() - 1, 0, pick, budget);
    }
    return taken;
  }

 private:
  struct Level {
    Group* groups;
    int64_t count;
  };

  template <class T>
  static void prefetch(const T& what) {
    for (size_t byte = 0; byte < sizeof(T); byte += 64) __builtin_prefetch(reinterpret_cast<const char*>(&what) + byte);
  }

  Pick pick_of(int64_t key) const {
    const uint32_t row = key == 0 ? 0 : ~static_cast<uint32_t>(key);
    const float* p = points_ + 3 * int64_t{row};
    return {p[0], p[1], p[2], row, key};
  }

  void start_leaf(Group& group, int child, int64_t index, const Pick& first) {
    Leaf& leaf = leaves_[index];
    const auto filled = static_cast<int>(std::min<int64_t>(kLeaf, count_ - index * kLeaf));
    std::fill_n(leaf.nearest, filled, kUnseen);
    for (int i = filled; i < kLeaf; ++i) {  // the last leaf is filled up with a point that counts as taken
      leaf.x[i] = leaf.x[filled - 1];
      leaf.y[i] = leaf.y[filled - 1];
      leaf.z[i] = leaf.z[filled - 1];
      leaf.nearest[i] = kTaken;
      leaf.row[i] = UINT32_MAX;
    }
    const float* axes[3] = {leaf.x, leaf.y, leaf.z};
    for (int axis = 0; axis < 3; ++axis) {
      auto low = load<FloatRegister>(axes[axis]), high = low;
      for (int i = kLanes; i < kLeaf; i += kLanes) {
        const auto some = load<FloatRegister>(axes[axis] + i);
        low = minimum(low, some);
        high = maximum(high, some);
      }
      group.low[axis][child] = lowest_lane<float>(low);
      group.high[axis][child] = highest_lane<float>(high);
    }
    group.set_key(child, leaf.update(first, true));
  }

  // Update what a pick changes below one group, and count the leaves and groups visited down from the budget. Returns
  // the key of its farthest point, which is not read from what was just written: that would wait for it.
  int64_t visit(size_t at, int64_t index, const Pick& pick, int64_t& budget) {
    Group& group = levels_[at].groups[index];
    const uint32_t reached = group.reached(pick);
    for (uint32_t rest = reached; rest != 0; rest &= rest - 1) {
      const int64_t child = index * kFan + __builtin_ctz(rest);
      if (at == 0)
        prefetch(leaves_[child]);
      else
        prefetch(levels_[at - 1].groups[child]);
    }
    int64_t farthest = group.farthest_beside(reached);
    budget -= 1 + (at == 0 ? __builtin_popcount(reached) : 0);
    for (uint32_t rest = reached; rest != 0; rest &= rest - 1) {
      const int child = __builtin_ctz(rest);
      const int64_t below = index * kFan + child;
      const int64_t key =
          at == 0 ? leaves_[below].update(pick, group.key[child] == pick.key) : visit(at - 1, below, pick, budget);
      group.set_key(child, key);
      farthest = std::max(farthest, key);
    }
    return farthest;
  }

  const float* points_;
  int64_t count_;
  int64_t num_leaves_;
  Leaf* leaves_;
  std::vector<Level> levels_;  // [0] above the leaves, the last a single group
};

}  // namespace pc::sampling
