// All points within a reach that is known from the start: nothing is kept sorted on the way.
#pragma once

#include "pc/neighbors/tree_search.hpp"

namespace pc::neighbors {

// Call body(leaf, lanes) for every leaf of a tree in which the `lanes` may have a neighbor: boxes are passed by as in
// TreeSearch.
template <class Body>
void for_leaves_within(const CloudTree& tree, const QueryGroup& queries, const FloatPack& reach, int level,
                       int64_t block, Body&& body) {
  const Boxes& boxes = tree.level[level][block];
  const FloatPack gaps = box_gaps(queries, boxes);
  // A gap of infinity is a missing box, or one too far for any distance in it to fit a float.
  PackMask near = less_equal(gaps, FloatPack(largest(reach))) & less(gaps, FloatPack(kInfinity));
  for (; near != 0; near &= near - 1) {
    const int slot = __builtin_ctz(near);
    const PackMask lanes = lanes_near(queries, boxes, slot, reach);
    if (lanes == 0) continue;
    const int64_t node = block * kFanOut + slot;
    if (level == 0)
      body(tree.leaf[node], lanes);
    else
      for_leaves_within(tree, queries, reach, level - 1, node, body);
  }
}

// The squared distances from one query to the points of a leaf, and which of them are below its limit.
struct LeafDistances {
  FloatPack squared;
  PackMask near;

  LeafDistances(const Leaf& leaf, float x, float y, float z, float limit)
      : squared(squared_length(FloatPack::load(leaf.x) - FloatPack(x), FloatPack::load(leaf.y) - FloatPack(y),
                               FloatPack::load(leaf.z) - FloatPack(z))),
        near(less(squared, FloatPack(limit))) {}
};

// The lane of a row in a leaf, as a mask; none where it is not there.
inline PackMask lane_of_row(const Leaf& leaf, uint32_t row) {
  PackMask mask = 0;
  for (int i = 0; i < kLeafSize; ++i) mask |= PackMask{leaf.row[i] == row} << i;
  return mask;
}

// Keys of distances and rows sorted by distances that are spread about evenly, as those of points on a surface are:
// dealt out over as many buckets as there are keys, which leaves a few in each. Those of other spreads fall into few
// buckets, and are compared.
class DistanceSorter {
 public:
  // Sort `count` keys; the distances are below `limit`. May leave the result in memory of its own.
  const uint64_t* sort(uint64_t* keys, int64_t count, float limit) {
    if (count <= kFew) {
      insert(keys, count);
      return keys;
    }
    const float scale = static_cast<float>(count) / limit;
    if (!(scale > 0 && scale < std::numeric_limits<float>::max())) {
      std::sort(keys, keys + count);
      return keys;
    }
    const auto buckets = static_cast<size_t>(count);
    end_.assign(buckets + 1, 0);
    bucket_.resize(buckets);
    sorted_.resize(buckets);
    const auto last = static_cast<int32_t>(buckets - 1);
    for (size_t i = 0; i < buckets; ++i)
      bucket_[i] = std::min(last, static_cast<int32_t>(NearKey::squared(keys[i]) * scale));
    for (size_t i = 0; i < buckets; ++i) ++end_[static_cast<size_t>(bucket_[i]) + 1];
    for (size_t b = 0; b < buckets; ++b) end_[b + 1] += end_[b];
    for (size_t i = 0; i < buckets; ++i) sorted_[end_[static_cast<size_t>(bucket_[i])]++] = keys[i];
    uint32_t begin = 0;  // end_[b] is now where bucket b ends
    for (size_t b = 0; b < buckets; begin = end_[b++]) {
      const uint32_t size = end_[b] - begin;
      if (size > kFew)
        std::sort(sorted_.data() + begin, sorted_.data() + begin + size);
      else if (size > 1)
        insert(sorted_.data() + begin, size);
    }
    return sorted_.data();
  }

 private:
  static constexpr int64_t kFew = 16;

  static void insert(uint64_t* keys, int64_t count) {
    for (int64_t i = 1; i < count; ++i) {
      const uint64_t key = keys[i];
      int64_t at = i;
      for (; at > 0 && keys[at - 1] > key; --at) keys[at] = keys[at - 1];
      keys[at] = key;
    }
  }

  std::vector<uint32_t> end_;
  std::vector<int32_t> bucket_;
  std::vector<uint64_t> sorted_;
};

}  // namespace pc::neighbors
