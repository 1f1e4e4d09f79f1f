// Voxels of a regular grid: their numbers, and the fixed-point sums of what falls into each.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

// A voxel's three coordinates in 63 bits, where its cloud's extent allows it.
struct PackedVoxel {
  uint64_t bits;

  PC_HD bool operator==(const PackedVoxel& other) const { return bits == other.bits; }
  PC_HD uint64_t hash() const { return mixed(bits); }

  // Consecutive coordinates differ in few low bits; multiplying moves those to the top (Fibonacci hashing).
  PC_HD static uint64_t mixed(uint64_t bits) { return bits * 0x9E3779B97F4A7C15u; }
};

// The same for any extent below 2^53 voxels.
struct WideVoxel {
  int64_t x, y, z;

  PC_HD bool operator==(const WideVoxel& other) const { return x == other.x && y == other.y && z == other.z; }
  PC_HD uint64_t hash() const {
    const auto a = static_cast<uint64_t>(x), b = static_cast<uint64_t>(y), c = static_cast<uint64_t>(z);
    return PackedVoxel::mixed(PackedVoxel::mixed(PackedVoxel::mixed(a) ^ (a >> 32) ^ b) ^ (b >> 32) ^ c);
  }
};

// The grid of one cloud. Coordinates of voxels are counted from the lowest that the cloud touches.
struct VoxelGrid {
  double origin[3];
  double size[3];
  double first[3];  // the lowest voxel, counted from the origin
  int bits[3];      // enough for the coordinates of this cloud; 0 where all are 0

  PC_HD bool packs() const { return bits[0] + bits[1] + bits[2] <= 63; }

  PC_HD PackedVoxel packed(int64_t x, int64_t y, int64_t z) const {
    return {static_cast<uint64_t>(x) << (bits[1] + bits[2]) | static_cast<uint64_t>(y) << bits[2] |
            static_cast<uint64_t>(z)};
  }
  PC_HD WideVoxel unpacked(const PackedVoxel& voxel) const {
    return {static_cast<int64_t>(voxel.bits >> (bits[1] + bits[2])), low_bits(voxel.bits >> bits[2], bits[1]),
            low_bits(voxel.bits, bits[2])};
  }
  PC_HD const WideVoxel& unpacked(const WideVoxel& voxel) const { return voxel; }

 private:
  PC_HD static int64_t low_bits(uint64_t value, int count) {
    return static_cast<int64_t>(value & ((uint64_t{1} << count) - 1));
  }
};

// Offsets of points inside their voxel, summed as multiples of 2^-31 voxel: exact in any order.
struct VoxelSum {
  int64_t x, y, z, count;

  PC_HD void add(int64_t ox, int64_t oy, int64_t oz) {
    x += ox;
    y += oy;
    z += oz;
    ++count;
  }
  PC_HD void add(const VoxelSum& other) {
    x += other.x;
    y += other.y;
    z += other.z;
    count += other.count;
  }
};

// Offsets are multiples of this part of a voxel, as in the reference.
constexpr double kFixedPoint = 2147483648.0;  // 2^31

// Write the mean (3,) of a voxel's points, with the reference's float64 operations.
template <class Voxel>
PC_HD void mean_of(const Voxel& voxel, const VoxelSum& sum, const VoxelGrid& grid, float* mean) {
  const WideVoxel corner = grid.unpacked(voxel);
  const int64_t coordinate[3] = {corner.x, corner.y, corner.z}, total[3] = {sum.x, sum.y, sum.z};
  for (int axis = 0; axis < 3; ++axis) {
    const double offset = static_cast<double>(total[axis]) / static_cast<double>(sum.count) / kFixedPoint;
    const double voxel = static_cast<double>(coordinate[axis]) + grid.first[axis];
    mean[axis] = static_cast<float>(grid.origin[axis] + (voxel + offset) * grid.size[axis]);
  }
}

}  // namespace pc::math
