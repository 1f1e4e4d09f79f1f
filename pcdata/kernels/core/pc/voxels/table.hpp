// A hash table that numbers voxels by first appearance.
#pragma once

#include "pc/math/voxel.hpp"
#include "pc/memory.hpp"

namespace pc::voxels {

// Open addressing with linear probing; grows by doubling, within room given once.
template <class Voxel>
class VoxelTable {
 public:
  // `keys` receives each new voxel at its number; it and the table have room for `most` voxels.
  VoxelTable(ScratchFrame& scratch, int64_t most) : room_(slots_for(most)), slots_(scratch.take<Slot>(room_)) {}

  void start(Voxel* keys) {
    keys_ = keys;
    count_ = 0;
    resize(std::min(room_, kFirstSlots));
  }

  // Return the number of a voxel, the next free one if it is new.
  int32_t number(const Voxel& voxel) {
    const uint64_t hash = voxel.hash();
    for (uint64_t at = hash >> shift_;; at = (at + 1) & mask_) {
      Slot& slot = slots_[at];
      if (slot.number == kFree) return add(voxel, slot, hash);
      if (slot.tag == static_cast<uint32_t>(hash) && keys_[slot.number] == voxel) return slot.number;
    }
  }
  void prefetch(const Voxel& voxel) const { __builtin_prefetch(slots_ + (voxel.hash() >> shift_)); }
  int64_t count() const { return count_; }

 private:
  static constexpr int32_t kFree = -1;
  static constexpr int64_t kFirstSlots = 1 << 12;  // 32 KB: small clouds should not clear more

  // Part of the hash instead of the voxel: 8 bytes whatever the voxel, and the keys are rarely read in vain.
  struct Slot {
    uint32_t tag;
    int32_t number;
  };

  // A power of two, never more than half full: linear probing then looks at 1.5 slots on average.
  static int64_t slots_for(int64_t most) {
    int64_t slots = 16;
    while (slots < 2 * most) slots *= 2;
    return slots;
  }

  int32_t add(const Voxel& voxel, Slot& slot, uint64_t hash) {
    keys_[count_] = voxel;
    slot = {static_cast<uint32_t>(hash), static_cast<int32_t>(count_)};
    if (2 * ++count_ > static_cast<int64_t>(mask_) && static_cast<int64_t>(mask_) + 1 < room_) {
      resize(4 * (static_cast<int64_t>(mask_) + 1));
      for (int64_t i = 0; i < count_; ++i) put_back(keys_[i], static_cast<int32_t>(i));
    }
    return static_cast<int32_t>(count_ - 1);
  }
  void put_back(const Voxel& voxel, int32_t number) {
    const uint64_t hash = voxel.hash();
    uint64_t at = hash >> shift_;
    while (slots_[at].number != kFree) at = (at + 1) & mask_;
    slots_[at] = {static_cast<uint32_t>(hash), number};
  }
  void resize(int64_t slots) {
    slots = std::min(slots, room_);
    mask_ = static_cast<uint64_t>(slots) - 1;
    shift_ = __builtin_clzll(mask_);
    for (int64_t i = 0; i < slots; ++i) slots_[i].number = kFree;
  }

  int64_t room_;
  Slot* slots_;
  Voxel* keys_ = nullptr;
  int64_t count_ = 0;
  uint64_t mask_ = 0;
  int shift_ = 0;
};

}  // namespace pc::voxels
