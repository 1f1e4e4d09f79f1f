// Numbering voxels by first appearance, and the fixed-point sums of what falls into each.
#pragma once

#include <cmath>

#include "pc/common.hpp"

namespace pc {

// A voxel's three coordinates in 63 bits, where its cloud's extent allows it.
struct PackedVoxel {
  uint64_t bits;

  bool operator==(const PackedVoxel& other) const { return bits == other.bits; }
  uint64_t hash() const { return mixed(bits); }

  // Consecutive coordinates differ in few low bits; multiplying moves those to the top (Fibonacci hashing).
  static uint64_t mixed(uint64_t bits) { return bits * 0x9E3779B97F4A7C15u; }
};

// The same for any extent below 2^53 voxels.
struct WideVoxel {
  int64_t x, y, z;

  bool operator==(const WideVoxel& other) const { return x == other.x && y == other.y && z == other.z; }
  uint64_t hash() const {
    const auto a = static_cast<uint64_t>(x), b = static_cast<uint64_t>(y), c = static_cast<uint64_t>(z);
    return PackedVoxel::mixed(PackedVoxel::mixed(PackedVoxel::mixed(a) ^ (a >> 32) ^ b) ^ (b >> 32) ^ c);
  }
};

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

// The grid of one cloud: Open3D's, half a voxel below the lowest corner.
struct VoxelGrid {
  double origin[3];
  double size;
  int bits[3];  // enough for the coordinates of this cloud; 0 where all are 0

  bool packs() const { return bits[0] + bits[1] + bits[2] <= 63; }

  PackedVoxel packed(int64_t x, int64_t y, int64_t z) const {
    return {static_cast<uint64_t>(x) << (bits[1] + bits[2]) | static_cast<uint64_t>(y) << bits[2] |
            static_cast<uint64_t>(z)};
  }
  WideVoxel unpacked(const PackedVoxel& voxel) const {
    auto low_bits = [](uint64_t value, int count) {
      return static_cast<int64_t>(value & ((uint64_t{1} << count) - 1));
    };
    return {static_cast<int64_t>(voxel.bits >> (bits[1] + bits[2])), low_bits(voxel.bits >> bits[2], bits[1]),
            low_bits(voxel.bits, bits[2])};
  }
  const WideVoxel& unpacked(const WideVoxel& voxel) const { return voxel; }
};

// Offsets of points inside their voxel, summed as multiples of 2^-31 voxel: exact in any order.
struct VoxelSum {
  int64_t x, y, z, count;

  void add(int64_t ox, int64_t oy, int64_t oz) {
    x += ox;
    y += oy;
    z += oz;
    ++count;
  }
  void add(const VoxelSum& other) {
    x += other.x;
    y += other.y;
    z += other.z;
    count += other.count;
  }
};

// Offsets are multiples of this part of a voxel, as in the reference.
constexpr double kFixedPoint = 2147483648.0;  // 2^31

// The mean of a voxel's points, with the reference's float64 operations.
template <class Voxel>
void mean_of(const Voxel& voxel, const VoxelSum& sum, const VoxelGrid& grid, float* mean) {
  const WideVoxel corner = grid.unpacked(voxel);
  const int64_t coordinate[3] = {corner.x, corner.y, corner.z}, total[3] = {sum.x, sum.y, sum.z};
  for (int axis = 0; axis < 3; ++axis) {
    const double offset = static_cast<double>(total[axis]) / static_cast<double>(sum.count) / kFixedPoint;
    mean[axis] = static_cast<float>(grid.origin[axis] + (static_cast<double>(coordinate[axis]) + offset) * grid.size);
  }
}

// Points of one cloud placed on its grid, a block at a time so that the arithmetic vectorises.
class VoxelBlock {
 public:
  static constexpr int kSize = 256;

  void place(const float* points, int count, const VoxelGrid& grid) {
    for (int axis = 0; axis < 3; ++axis) {
      const double origin = grid.origin[axis], size = grid.size;
      double* whole = voxel_[axis];
      int64_t* offset = offset_[axis];
      for (int i = 0; i < count; ++i) {
        const double scaled = (static_cast<double>(points[3 * i + axis]) - origin) / size;
        whole[i] = std::floor(scaled);
        offset[i] = rounded((scaled - whole[i]) * kFixedPoint);
      }
    }
  }
  int64_t offset(int axis, int i) const { return offset_[axis][i]; }

  void keys(int count, const VoxelGrid& grid, PackedVoxel* to) const {
    for (int i = 0; i < count; ++i)
      to[i] = grid.packed(rounded(voxel_[0][i]), rounded(voxel_[1][i]), rounded(voxel_[2][i]));
  }
  void keys(int count, const VoxelGrid&, WideVoxel* to) const {
    for (int i = 0; i < count; ++i)
      to[i] = {static_cast<int64_t>(voxel_[0][i]), static_cast<int64_t>(voxel_[1][i]),
               static_cast<int64_t>(voxel_[2][i])};
  }

 private:
  // Round half to even, as torch does. Adding 1.5 * 2^52 leaves the integer in the low bits of the double; exact below
  // 2^51, which packed coordinates and offsets always are.
  static int64_t rounded(double value) {
    constexpr double kMagic = 6755399441055744.0;
    const double shifted = value + kMagic;
    int64_t bits, base;
    std::memcpy(&bits, &shifted, sizeof bits);
    std::memcpy(&base, &kMagic, sizeof base);
    return bits - base;
  }

  alignas(64) double voxel_[3][kSize];
  alignas(64) int64_t offset_[3][kSize];
};

}  // namespace pc
