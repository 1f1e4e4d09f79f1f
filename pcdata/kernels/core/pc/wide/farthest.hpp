// Exact farthest point sampling of points of any number of columns; what sampling::FarthestSampler does for three.
#pragma once

#include <algorithm>
#include <cstring>
#include <vector>

#include "pc/wide/tree.hpp"

namespace pc::wide {

// Every node of the tree knows its farthest point as one key: the bits of the squared distance to the nearest pick
// above the complement of the row, so that the larger key is the farther point and, among equals, the lower row. A box
// that is not nearer to a pick than its farthest point is to the picks before cannot change (see
// sampling::FarthestSampler).
class Sampler {
 public:
  Sampler(ScratchFrame& scratch, const float* points, int64_t count, int64_t width)
      : points_(points), tree_(scratch, count, width), nearest_(scratch.take<int32_t>(tree_.num_leaves() * kLeaf)) {
    for (int level = 0; level < tree_.num_levels(); ++level)
      keys_.push_back(scratch.take<Keys>(tree_.num_blocks(level)));
  }

  void start(const pc_context& context, bool alone) {
    tree_.build(context, points_, 0, alone);
    for (int64_t leaf = 0; leaf < tree_.num_leaves(); ++leaf)
      for (int i = 0; i < kLeaf; ++i) nearest_[leaf * kLeaf + i] = tree_.rows(leaf)[i] == kNoRow ? kTaken : kUnseen;
    const Pick first = pick_of(0);
    for (int level = 0; level < tree_.num_levels(); ++level) {
      const int64_t nodes = level == 0 ? tree_.num_leaves() : tree_.num_blocks(level - 1);
      for (int64_t node = 0; node < tree_.num_blocks(level) * kFan; ++node) {
        const int64_t key = node >= nodes ? INT64_MIN : level == 0 ? update(node, first) : farthest(level - 1, node);
        set(level, node, key);
      }
    }
  }

  // Write further picks (rows), until `wanted` are taken or the work is worth `budget` leaves; return how many there
  // are now. Call it again to go on.
  int64_t advance(int64_t* picks, int64_t taken, int64_t wanted, int64_t budget) {
    if (taken == 0) picks[taken++] = 0;
    const int top = tree_.num_levels() - 1;
    while (taken < wanted && budget > 0) {
      const Pick pick = pick_of(farthest(top, 0));
      picks[taken++] = pick.row;
      budget -= visit(top, 0, pick);
    }
    return taken;
  }

 private:
  static constexpr int32_t kTaken = -1;           // below the bits of every distance
  static constexpr int32_t kUnseen = 0x7F800000;  // infinity

  struct Pick {
    const float* at;
    uint32_t row;
    int64_t key;  // of the leaf and of every node above the pick
  };
  // Of the sixteen nodes of a block.
  struct alignas(64) Keys {
    float bound[kFan];  // squared distance of the farthest point
    int64_t key[kFan];
  };

  Pick pick_of(int64_t key) const {
    const uint32_t row = key == 0 ? 0 : ~static_cast<uint32_t>(key);
    return {points_ + int64_t{row} * tree_.width(), row, key};
  }
  Keys& keys(int level, int64_t block) { return keys_[static_cast<size_t>(level)][block]; }

  void set(int level, int64_t node, int64_t key) {
    Keys& own = keys(level, node / kFan);
    const auto bits = static_cast<int32_t>(key >> 32);
    own.key[node % kFan] = key;
    own.bound[node % kFan] = -1.0F;  // nothing is nearer than a box of taken points
    if (bits >= 0) std::memcpy(own.bound + node % kFan, &bits, sizeof bits);
  }
  int64_t farthest(int level, int64_t block) {
    const Keys& own = keys(level, block);
    return *std::max_element(own.key, own.key + kFan);
  }

  // Take note of a pick; return the key of the leaf's farthest point.
  int64_t update(int64_t leaf, const Pick& pick) {
    const Columns columns = tree_.leaf(leaf);
    FloatPack sum(0.0F);
    for (int64_t column = 0; column < tree_.width(); ++column) {
      const FloatPack offset = FloatPack::load(columns[column]) - FloatPack(pick.at[column]);
      sum = sum + offset * offset;
    }
    alignas(64) float squared[kLeaf];
    int32_t bits[kLeaf];
    sum.store(squared);
    std::memcpy(bits, squared, sizeof bits);
    int32_t* nearest = nearest_ + leaf * kLeaf;
    const uint32_t* rows = tree_.rows(leaf);
    int64_t best = INT64_MIN;
    for (int i = 0; i < kLeaf; ++i) {
      // Distances are not negative, so their bits compare as they do.
      int32_t now = bits[i] < nearest[i] ? bits[i] : nearest[i];
      now = rows[i] == pick.row ? kTaken : now;
      nearest[i] = now;
      const int64_t key = int64_t{now} * (int64_t{1} << 32) + static_cast<uint32_t>(~rows[i]);
      best = key > best ? key : best;
    }
    return best;
  }

  // The children that a pick may change, as a bit mask. Once only duplicates of picks are left, it changes itself
  // alone.
  PackMask reached(int level, int64_t block, const Pick& pick) {
    const Keys& own = keys(level, block);
    if (pick.key >> 32 == 0) return PackMask{1} << (std::find(own.key, own.key + kFan, pick.key) - own.key);
    const Columns low = tree_.low(level, block), high = tree_.high(level, block);
    FloatPack sum(0.0F);
    for (int64_t column = 0; column < tree_.width(); ++column) {
      const FloatPack at(pick.at[column]);
      const FloatPack gap =
          maximum(maximum(FloatPack::load(low[column]) - at, at - FloatPack::load(high[column])), FloatPack(0.0F));
      sum = sum + gap * gap;
    }
    return less(sum, FloatPack::load(own.bound));
  }

  // Update what a pick changes below one block; return the number of leaves and blocks visited.
  int64_t visit(int level, int64_t block, const Pick& pick) {
    int64_t visited = 1;
    for (PackMask rest = reached(level, block, pick); rest != 0; rest &= rest - 1) {
      const int64_t node = block * kFan + __builtin_ctz(rest);
      if (level == 0) {
        set(0, node, update(node, pick));
        ++visited;
      } else {
        visited += visit(level - 1, node, pick);
        set(level, node, farthest(level - 1, node));
      }
    }
    return visited;
  }

  const float* points_;
  Tree tree_;
  int32_t* nearest_;  // (leaves, 16) bits of the squared distance to the nearest pick, or kTaken
  std::vector<Keys*> keys_;
};

}  // namespace pc::wide
