// Points in Morton order cut into leaves of sixteen.
#pragma once

#include <algorithm>
#include <atomic>

#include "pc/memory.hpp"
#include "pc/neighbors/nearest.hpp"
#include "pc/sort/morton_rows.hpp"
#include "pc/threads.hpp"

namespace pc::neighbors {

constexpr int kLeafSize = kQueries;

// Sixteen points; empty slots lie at infinity, so their distances need no mask, and have row kNoId.
struct alignas(64) Leaf {
  float x[kLeafSize], y[kLeafSize], z[kLeafSize];
  uint32_t row[kLeafSize];
};

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

// A batch of ragged clouds as leaves: those of cloud b are leaf_ptr[b] to leaf_ptr[b+1].
struct Leaves {
  Leaf* leaf;
  const int64_t* leaf_ptr;  // (B+1)
  int64_t num_clouds;

  int64_t count() const { return leaf_ptr[num_clouds]; }
};

// What a leaf is made of: rows in Morton order, already sorted.
inline void fill_leaf(const float* points, const uint64_t* keys, int64_t count, Leaf& leaf) {
  for (int64_t i = 0; i < kLeafSize; ++i) {
    const bool real = i < count;
    const uint32_t row = real ? sort::MortonRows::row(keys[i]) : kNoId;
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
    require_numbered(ptr[num_clouds]);
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
    const float *p = points_ + 3 * int64_t{sort::MortonRows::row(a)},
                *q = points_ + 3 * int64_t{sort::MortonRows::row(b)};
    return p[0] == q[0] && p[1] == q[1] && p[2] == q[2];
  }

  void sort(uint64_t* spare) {
    const sort::MortonRows order(context_, points_);
    int64_t b = 0;
    while (b < num_clouds_) {
      // Small clouds are shared out among threads, large ones are sorted by all threads.
      const int64_t first = b;
      while (b < num_clouds_ && ptr_[b + 1] - ptr_[b] < sort::MortonRows::kParallelFrom) ++b;
      parallel_for(context_, b - first, 1, [&](int64_t i, int64_t, int64_t) {
        const int64_t begin = ptr_[first + i], at = begin - ptr_[0];
        order.sort_small_cloud(begin, ptr_[first + i + 1], keys_ + at, spare + at);
      });
      for (; b < num_clouds_ && ptr_[b + 1] - ptr_[b] >= sort::MortonRows::kParallelFrom; ++b)
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

}  // namespace pc::neighbors
