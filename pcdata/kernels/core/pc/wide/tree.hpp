// A tree of boxes over points of any number of columns.
//
// Points are put in order by halving each cloud at the median of its widest column, again and again, down to leaves of
// sixteen; boxes of leaves that follow one another have boxes above them, sixteen to one, up to a single block.
#pragma once

#include <algorithm>
#include <limits>
#include <vector>

#include "pc/memory.hpp"
#include "pc/pack.hpp"
#include "pc/threads.hpp"

namespace pc::wide {

constexpr int kLeaf = kPackLanes;
constexpr int kFan = kPackLanes;
constexpr uint32_t kNoRow = ~uint32_t{0};
constexpr float kInfinity = std::numeric_limits<float>::infinity();

// Ragged clouds of points of `width` columns.
struct Clouds {
  const float* points;  // (N, width)
  const int64_t* ptr;   // (B+1,)
  int64_t num_clouds;
  int64_t width;

  const float* point(int64_t row) const { return points + row * width; }
};

// Sixteen points or boxes of any width: arrays of sixteen numbers, one per column.
struct Columns {
  float* at;

  float* operator[](int64_t column) const { return at + column * kPackLanes; }
};

// One cloud. Leaves that are not full have row kNoRow and coordinates at infinity in the places that are left.
class Tree {
 public:
  // Take room for `count` points; build() fills it.
  Tree(ScratchFrame& scratch, int64_t count, int64_t width) : width_(width), count_(count) {
    require_numbered(count);
    num_leaves_ = (count + kLeaf - 1) / kLeaf;
    rows_ = scratch.take<uint32_t>(num_leaves_ * kLeaf);
    coordinates_ = scratch.take<float>(num_leaves_ * kLeaf * width);
    for (int64_t nodes = num_leaves_; nodes > 0 && (levels_.empty() || nodes > 1);) {
      nodes = (nodes + kFan - 1) / kFan;
      levels_.push_back({scratch.take<float>(nodes * 2 * kFan * width), nodes});
    }
  }

  int64_t num_leaves() const { return num_leaves_; }
  int num_levels() const { return static_cast<int>(levels_.size()); }
  int64_t num_blocks(int level) const { return levels_[static_cast<size_t>(level)].blocks; }
  int64_t width() const { return width_; }
  const uint32_t* rows(int64_t leaf) const { return rows_ + leaf * kLeaf; }
  Columns leaf(int64_t leaf) const { return {coordinates_ + leaf * kLeaf * width_}; }
  Columns low(int level, int64_t block) const {
    return {levels_[static_cast<size_t>(level)].boxes + block * 2 * kFan * width_};
  }
  Columns high(int level, int64_t block) const { return {low(level, block).at + kFan * width_}; }

  // Of points (count, width), whose first has the row `first`.
  void build(const pc_context& context, const float* points, int64_t first, bool alone) {
    order(context, points, alone);
    const auto fill = [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t leaf = begin; leaf < end; ++leaf) fill_leaf(points, first, leaf);
    };
    if (alone)
      fill(0, num_leaves_, 0);
    else
      parallel_for(context, num_leaves_, 64, fill);
    for (int level = 0; level < num_levels(); ++level)
      for (int64_t block = 0; block < num_blocks(level); ++block) fill_block(level, block);
  }

 private:
  struct Level {
    float* boxes;
    int64_t blocks;
  };
  struct Place {
    float value;
    uint32_t row;
  };
  struct Part {
    int64_t begin, end;
  };

  // Halve all parts until they are leaves; parts of one round have nothing to do with one another.
  void order(const pc_context& context, const float* points, bool alone) {
    for (int64_t i = 0; i < count_; ++i) rows_[i] = static_cast<uint32_t>(i);
    std::fill(rows_ + count_, rows_ + num_leaves_ * kLeaf, kNoRow);
    std::vector<Part> parts{{0, count_}}, next;
    while (!parts.empty()) {
      next.assign(2 * parts.size(), {0, 0});
      const auto halve_some = [&](int64_t begin, int64_t end, int64_t) {
        std::vector<Place> places;
        std::vector<float> box;
        for (int64_t i = begin; i < end; ++i) {
          const Part part = parts[static_cast<size_t>(i)];
          if (part.end - part.begin <= kLeaf) continue;
          const int64_t middle = halve(points, part, places, box);
          next[static_cast<size_t>(2 * i)] = {part.begin, middle};
          next[static_cast<size_t>(2 * i + 1)] = {middle, part.end};
        }
      };
      const auto count = static_cast<int64_t>(parts.size());
      if (alone)
        halve_some(0, count, 0);
      else
        parallel_for(context, count, std::max<int64_t>(1, count / 64), halve_some);
      parts.clear();
      for (const Part& part : next)
        if (part.end - part.begin > kLeaf) parts.push_back(part);
    }
  }

  // Put the lower half of a part in front of the upper one; all leaves but the last are full.
  int64_t halve(const float* points, const Part& part, std::vector<Place>& places, std::vector<float>& box) const {
    const auto width = static_cast<size_t>(width_);
    box.assign(2 * width, kInfinity);
    for (size_t column = 0; column < width; ++column) box[width + column] = -kInfinity;
    for (int64_t i = part.begin; i < part.end; ++i) {
      const float* point = points + rows_[i] * width_;
      for (size_t column = 0; column < width; ++column) {
        box[column] = std::min(box[column], point[column]);
        box[width + column] = std::max(box[width + column], point[column]);
      }
    }
    size_t widest = 0;
    for (size_t column = 1; column < width; ++column)
      if (box[width + column] - box[column] > box[width + widest] - box[widest]) widest = column;
    places.resize(static_cast<size_t>(part.end - part.begin));
    for (int64_t i = part.begin; i < part.end; ++i)
      places[static_cast<size_t>(i - part.begin)] = {points[rows_[i] * width_ + static_cast<int64_t>(widest)],
                                                     rows_[i]};
    const int64_t leaves = (part.end - part.begin + kLeaf - 1) / kLeaf, middle = (leaves + 1) / 2 * kLeaf;
    std::nth_element(places.begin(), places.begin() + static_cast<ptrdiff_t>(middle), places.end(),
                     [](const Place& a, const Place& b) { return a.value < b.value; });
    for (int64_t i = part.begin; i < part.end; ++i) rows_[i] = places[static_cast<size_t>(i - part.begin)].row;
    return part.begin + middle;
  }

  void fill_leaf(const float* points, int64_t first, int64_t leaf) {
    uint32_t* rows = rows_ + leaf * kLeaf;
    const Columns columns = this->leaf(leaf);
    for (int i = 0; i < kLeaf; ++i) {
      const bool real = rows[i] != kNoRow;
      const float* point = points + (real ? rows[i] : 0) * width_;
      for (int64_t column = 0; column < width_; ++column) columns[column][i] = real ? point[column] : kInfinity;
      if (real) rows[i] += static_cast<uint32_t>(first);
    }
  }

  void fill_block(int level, int64_t block) {
    const Columns lows = low(level, block), highs = high(level, block);
    const int64_t nodes = level == 0 ? num_leaves_ : num_blocks(level - 1);
    for (int slot = 0; slot < kFan; ++slot) {
      const int64_t node = block * kFan + slot;
      for (int64_t column = 0; column < width_; ++column) {
        float least = kInfinity, most = -kInfinity;
        if (node < nodes) {
          const float* from = level == 0 ? leaf(node)[column] : low(level - 1, node)[column];
          const float* to = level == 0 ? from : high(level - 1, node)[column];
          for (int i = 0; i < kFan; ++i) {
            if (from[i] == kInfinity) continue;  // a place without a point, or a box without one
            least = std::min(least, from[i]);
            most = std::max(most, to[i]);
          }
        }
        lows[column][slot] = least;
        highs[column][slot] = most;
      }
    }
  }

  int64_t width_, count_, num_leaves_ = 0;
  uint32_t* rows_ = nullptr;
  float* coordinates_ = nullptr;
  std::vector<Level> levels_;
};

// The trees of all clouds: small clouds are shared out among threads, large ones built by all.
inline std::vector<Tree> build_trees(const pc_context& context, ScratchFrame& scratch, const Clouds& clouds) {
  constexpr int64_t kTogetherFrom = 1 << 14;
  std::vector<Tree> trees;
  for (int64_t b = 0; b < clouds.num_clouds; ++b)
    trees.emplace_back(scratch, clouds.ptr[b + 1] - clouds.ptr[b], clouds.width);
  const auto is_large = [&](int64_t b) { return clouds.ptr[b + 1] - clouds.ptr[b] >= kTogetherFrom; };
  const auto build = [&](int64_t b, bool alone) {
    trees[static_cast<size_t>(b)].build(context, clouds.point(clouds.ptr[b]), clouds.ptr[b], alone);
  };
  parallel_for(context, clouds.num_clouds, 8, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t b = begin; b < end; ++b)
      if (!is_large(b)) build(b, true);
  });
  for (int64_t b = 0; b < clouds.num_clouds; ++b)
    if (is_large(b)) build(b, false);
  return trees;
}

}  // namespace pc::wide
