// Blocks of 8x8x8 voxels of a truncated signed distance field, named by one 63-bit key: pcdata/functional/tsdf/grid.py.
#pragma once

#include "pc/math/voxel.hpp"

namespace pc::math {

constexpr int64_t kBlocksPerSide = int64_t{1} << 20;
constexpr int kEdge = 8, kSlab = kEdge * kEdge, kVoxels = kEdge * kSlab;  // of a block: along an axis, of one z, in all
constexpr float kTsdfScale = 32767, kMaxWeight = 32767;

struct BlockPlace {
  int64_t x, y, z;

  PC_HD static BlockPlace of(int64_t key) {
    constexpr int64_t low = 2 * kBlocksPerSide - 1;
    return {(key >> 42) - kBlocksPerSide, ((key >> 21) & low) - kBlocksPerSide, (key & low) - kBlocksPerSide};
  }
  PC_HD bool is_within() const { return is_within(x) && is_within(y) && is_within(z); }
  PC_HD int64_t key() const {
    return ((x + kBlocksPerSide) << 42) | ((y + kBlocksPerSide) << 21) | (z + kBlocksPerSide);
  }

 private:
  PC_HD static bool is_within(int64_t place) { return place > -kBlocksPerSide && place < kBlocksPerSide; }
};

// Where a table of 2^(64 - shift) places begins to look for a block.
PC_HD int64_t first_place(int64_t key, int shift) {
  return static_cast<int64_t>(PackedVoxel::mixed(static_cast<uint64_t>(key)) >> shift);
}

}  // namespace pc::math
