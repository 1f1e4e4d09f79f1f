// The distances to the nearest points, without knowing which these are.
#pragma once

#include "pc/neighbors/sorting_network.hpp"

namespace pc::neighbors {

// The k smallest squared distances, ascending, without knowing whose they are. Empty places hold the limit.
//
// start() may be given limits that the caller knows to be the k-th smallest of some of the candidates: then places that
// still hold the limit at the end hold the right value.
//
// Offers wait until there are eight, which a network sorts and merges into the sorted blocks of eight: half the
// exchanges that inserting one at a time takes.
class NearestDistances {
 public:
  static constexpr int kMax = 48;

  void start(int k, const FloatPack& limit) {
    k_ = k;
    blocks_ = (k + kBlock - 1) / kBlock;
    filled_ = waiting_ = 0;
    limit_ = bound_ = limit;
  }
  const FloatPack& bound() const { return bound_; }
  float widest() const { return largest(bound_); }
  PackMask wants(const FloatPack& squared) const { return less(squared, bound_); }

  void offer(const FloatPack& squared, const Ids&) {
    minimum(squared, limit_).store(waiting_value_[waiting_]);
    if (++waiting_ == kBlock) merge();
  }
  void settle() {
    if (waiting_ == 0) return;
    // Places too many are filled as if they were empty.
    while (waiting_ < kBlock) limit_.store(waiting_value_[waiting_++]);
    merge();
  }
  void finish() {
    settle();
    for (; filled_ < blocks_; ++filled_)
      for (int i = 0; i < kBlock; ++i) limit_.store(value_[filled_ * kBlock + i]);
    bound_ = squared(k_ - 1);
  }
  // The i-th smallest, 0 <= i < k.
  FloatPack squared(int i) const { return FloatPack::load(value_[i]); }

 private:
  static constexpr int kBlock = 8;

  void merge() {
    EightPacks carried = EightPacks::load(waiting_value_);
    waiting_ = 0;
    carried.sort();
    int block = filled_;
    if (filled_ < blocks_) {
      ++filled_;
    } else {
      // Of the last block and the newcomers the farthest eight leave.
      --block;
      carried = EightPacks::nearer(EightPacks::load(at(block)), carried);
      carried.sort_bitonic();
    }
    // Down through the blocks: the farther eight of a block and of what is carried stay one place above it.
    for (; block > 0; --block) {
      const EightPacks below = EightPacks::load(at(block - 1));
      if (less(carried.v[0], below.v[7]) == 0) break;
      EightPacks stays = EightPacks::farther(below, carried);
      stays.sort_bitonic();
      stays.store(at(block));
      carried = EightPacks::nearer(below, carried);
      carried.sort_bitonic();
    }
    carried.store(at(block));
    if (filled_ == blocks_) bound_ = squared(k_ - 1);
  }

  float (*at(int block)) [kQueries] { return value_ + block * kBlock; }

  alignas(64) float value_[kMax][kQueries];  // the first `filled_` blocks, ascending per lane
  alignas(64) float waiting_value_[kBlock][kQueries];
  FloatPack limit_, bound_;
  int k_, blocks_, filled_, waiting_;
};

}  // namespace pc::neighbors
