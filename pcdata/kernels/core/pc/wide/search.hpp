// The nearest points of any number of columns, for sixteen queries at once.
#pragma once

#include <algorithm>
#include <vector>

#include "pc/neighbors/nearest.hpp"
#include "pc/wide/tree.hpp"

namespace pc::wide {

using neighbors::Ids;
using neighbors::kOff;

// What the differences of the columns add up to: a distance, or its square. Never less than over fewer columns.
struct Straight {
  static FloatPack add(const FloatPack& sum, const FloatPack& difference) { return sum + difference * difference; }
};
struct Summed {  // the sum of their sizes
  static FloatPack add(const FloatPack& sum, const FloatPack& difference) {
    return sum + maximum(difference, FloatPack(0.0F) - difference);
  }
};
struct Largest {
  static FloatPack add(const FloatPack& sum, const FloatPack& difference) {
    return maximum(sum, maximum(difference, FloatPack(0.0F) - difference)) + FloatPack(0.0F);  // never -0
  }
};

// Sixteen queries, one per lane, and the box around them.
template <class Norm>
class QueryGroup {
 public:
  explicit QueryGroup(int64_t width)
      : columns_(static_cast<size_t>(width)), low_(columns_.size()), high_(columns_.size()) {}

  // The points of a leaf; places without one become finite, so that no arithmetic meets NaN, and inactive.
  void take(const Tree& tree, int64_t leaf) {
    active_ = 0;
    for (int lane = 0; lane < kLeaf; ++lane) active_ |= static_cast<PackMask>(tree.rows(leaf)[lane] != kNoRow) << lane;
    for (size_t column = 0; column < columns_.size(); ++column) {
      const float* at = tree.leaf(leaf)[static_cast<int64_t>(column)];
      float low = kInfinity, high = -kInfinity;
      for (int lane = 0; lane < kLeaf; ++lane) {
        low = std::min(low, at[lane]);
        high = at[lane] == kInfinity ? high : std::max(high, at[lane]);
      }
      low_[column] = low;
      high_[column] = high;
      columns_[column] = minimum(FloatPack::load(at), FloatPack(std::numeric_limits<float>::max()));
    }
  }

  size_t width() const { return columns_.size(); }
  PackMask active() const { return active_; }
  const FloatPack& column(size_t column) const { return columns_[column]; }

  // `limit` in the lanes that count, off in the others.
  FloatPack limits(float limit) const {
    alignas(64) float value[kPackLanes];
    for (int lane = 0; lane < kPackLanes; ++lane) value[lane] = active_ >> lane & 1 ? limit : kOff;
    return FloatPack::load(value);
  }

  // Gaps between the box of the group and sixteen boxes, as Norm has distances.
  FloatPack gaps(const Columns& low, const Columns& high) const {
    FloatPack sum(0.0F);
    for (size_t column = 0; column < columns_.size(); ++column) {
      const auto c = static_cast<int64_t>(column);
      const FloatPack gap = maximum(maximum(FloatPack::load(low[c]) - FloatPack(high_[column]),
                                            FloatPack(low_[column]) - FloatPack::load(high[c])),
                                    FloatPack(0.0F));
      sum = Norm::add(sum, gap);
    }
    return sum;
  }

  // The lanes whose query has at most `reach` between itself and the box in one slot.
  PackMask near(const Columns& low, const Columns& high, int slot, const FloatPack& reach) const {
    FloatPack sum(0.0F);
    for (size_t column = 0; column < columns_.size(); ++column) {
      const auto c = static_cast<int64_t>(column);
      const FloatPack& at = columns_[column];
      const FloatPack gap =
          maximum(maximum(FloatPack(low[c][slot]) - at, at - FloatPack(high[c][slot])), FloatPack(0.0F));
      sum = Norm::add(sum, gap);
    }
    return less_equal(sum, reach);
  }

 private:
  std::vector<FloatPack> columns_;
  std::vector<float> low_, high_;
  PackMask active_ = 0;
};

// Walks a tree from its root, the nearest boxes first. A box is passed by only when its computed gap exceeds what is
// wanted: a gap takes the operations of a point's distance in the same order and rounding is monotone, so it never
// exceeds the computed distance of a point inside. So do sums over the first few columns.
template <class Norm, class Nearest>
class Search {
 public:
  Search(const Tree& tree, const QueryGroup<Norm>& group, Nearest& nearest)
      : tree_(tree), group_(group), nearest_(nearest) {}

  void run() {
    if (tree_.num_leaves() > 0) descend(tree_.num_levels() - 1, 0);
  }

 private:
  static constexpr size_t kTogether = 8;  // columns summed before a look at what is still wanted

  struct Child {
    float gap;
    int slot;
  };

  void descend(int level, int64_t block) {
    const Columns low = tree_.low(level, block), high = tree_.high(level, block);
    alignas(64) float gap[kFan];
    const FloatPack gaps = group_.gaps(low, high);
    // A gap of infinity is a missing box, or one too far for any distance in it to fit a float.
    PackMask near = less_equal(gaps, FloatPack(nearest_.widest())) & less(gaps, FloatPack(kInfinity));
    gaps.store(gap);
    Child children[kFan];
    int count = 0;
    for (; near != 0; near &= near - 1) {
      const int slot = __builtin_ctz(near);
      int at = count++;
      for (; at > 0 && children[at - 1].gap > gap[slot]; --at) children[at] = children[at - 1];
      children[at] = {gap[slot], slot};
    }
    for (int i = 0; i < count; ++i) {
      if (children[i].gap > nearest_.widest()) break;
      if (!group_.near(low, high, children[i].slot, nearest_.bound())) continue;
      const int64_t node = block * kFan + children[i].slot;
      if (level == 0)
        visit(node);
      else
        descend(level - 1, node);
    }
  }

  void visit(int64_t leaf) {
    const Columns points = tree_.leaf(leaf);
    const uint32_t* rows = tree_.rows(leaf);
    const size_t width = group_.width();
    for (int i = 0; i < kLeaf && rows[i] != kNoRow; ++i) {
      FloatPack squared(0.0F);
      size_t column = 0;
      for (;;) {
        const size_t end = std::min(width, column + kTogether);
        for (; column < end; ++column) {
          const FloatPack offset = FloatPack(points[static_cast<int64_t>(column)][i]) - group_.column(column);
          squared = Norm::add(squared, offset);
        }
        if (!nearest_.wants(squared)) break;
        if (column < width) continue;
        nearest_.offer(squared, Ids::same(rows[i]));
        break;
      }
    }
    nearest_.settle();
  }

  const Tree& tree_;
  const QueryGroup<Norm>& group_;
  Nearest& nearest_;
};

}  // namespace pc::wide
