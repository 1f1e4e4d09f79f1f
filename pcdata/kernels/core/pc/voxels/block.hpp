// Points placed on the grid of their cloud.
#pragma once

#include <cstring>

#include "pc/math/voxel.hpp"

namespace pc::voxels {

using math::kFixedPoint;
using math::PackedVoxel;
using math::VoxelGrid;
using math::VoxelSum;
using math::WideVoxel;

// A block of points of one cloud at a time, so that the arithmetic vectorizes.
class VoxelBlock {
 public:
  static constexpr int kSize = 256;

  void place(const float* points, int count, const VoxelGrid& grid) {
    for (int axis = 0; axis < 3; ++axis) {
      const double origin = grid.origin[axis], size = grid.size[axis], first = grid.first[axis];
      double* whole = voxel_[axis];
      int64_t* offset = offset_[axis];
      for (int i = 0; i < count; ++i) {
        const double scaled = (static_cast<double>(points[3 * i + axis]) - origin) / size;
        const double voxel = std::floor(scaled);
        whole[i] = voxel - first;
        offset[i] = rounded((scaled - voxel) * kFixedPoint);
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

}  // namespace pc::voxels
