// Blocks of 8x8x8 voxels of a truncated signed distance field, named by one 63-bit key: pcdata/functional/tsdf/grid.py.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

constexpr int64_t kBlocksPerSide = int64_t{1} << 20;

struct BlockPlace {
  int64_t x, y, z;

  PC_HD static BlockPlace of(int64_t key) {
    constexpr int64_t low = 2 * kBlocksPerSide - 1;
    return {(key >> 42) - kBlocksPerSide, ((key >> 21) & low) - kBlocksPerSide, (key & low) - kBlocksPerSide};
  }
  PC_HD int64_t key() const {
    return ((x + kBlocksPerSide) << 42) | ((y + kBlocksPerSide) << 21) | (z + kBlocksPerSide);
  }
};

}  // namespace pc::math
