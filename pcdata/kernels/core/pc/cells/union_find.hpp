// Disjoint sets that many threads may join at once.
#pragma once

#include <atomic>
#include <cstdint>
#include <utility>

namespace pc::cells {

// Every set is named by its lowest member. A parent is never above its child and only ever falls, so a reader that sees
// an old parent is only a few steps late, and relaxed atomics are enough.
//
// Source: Jayanti & Tarjan, A randomized concurrent algorithm for disjoint set union, PODC 2016 (path halving), with
// the members' own order in place of the random one.
class UnionFind {
 public:
  UnionFind(std::atomic<uint32_t>* parent, int64_t count) : parent_(parent) {
    for (int64_t i = 0; i < count; ++i) new (parent_ + i) std::atomic<uint32_t>(static_cast<uint32_t>(i));
  }

  uint32_t find(uint32_t member) {
    for (;;) {
      uint32_t parent = parent_[member].load(std::memory_order_relaxed);
      const uint32_t above = parent_[parent].load(std::memory_order_relaxed);
      if (parent == above) return parent;
      parent_[member].compare_exchange_weak(parent, above, std::memory_order_relaxed);
      member = above;
    }
  }

  bool joined(uint32_t a, uint32_t b) { return find(a) == find(b); }

  void join(uint32_t a, uint32_t b) {
    for (;;) {
      a = find(a);
      b = find(b);
      if (a == b) return;
      if (a > b) std::swap(a, b);
      uint32_t root = b;  // b stays a root only if no other thread joined it meanwhile
      if (parent_[b].compare_exchange_strong(root, a, std::memory_order_relaxed)) return;
    }
  }

 private:
  std::atomic<uint32_t>* parent_;
};

}  // namespace pc::cells
