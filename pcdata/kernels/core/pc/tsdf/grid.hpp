// The grid of a truncated signed distance field and what a view needs to be averaged into it. The layout of keys,
// blocks and planes is that of pcdata/functional/tsdf; results equal that reference bit for bit.
#pragma once

#include <cstdint>

#include "pc/math/voxel_block.hpp"

namespace pc::tsdf {

using math::BlockPlace;
using math::kBlocksPerSide;
using math::kEdge;
using math::kMaxWeight;
using math::kSlab;
using math::kTsdfScale;
using math::kVoxels;

// One plane of all blocks: chunk by chunk, null where the volume has no such plane.
template <class T>
struct VoxelPlane {
  static constexpr int64_t kChunk = 8192;  // blocks
  const int64_t* chunks;                   // addresses of the plane in each chunk's first block
  int64_t stride;                          // bytes from block to block

  explicit operator bool() const { return chunks != nullptr; }
  T* block(int64_t row) const {
    return reinterpret_cast<T*>(static_cast<uintptr_t>(chunks[row / kChunk] + row % kChunk * stride));
  }
};

// The planes of a block lie behind one another.
struct VoxelPlanes {
  VoxelPlane<int16_t> tsdf, weight;
  VoxelPlane<int32_t> color;
  VoxelPlane<int16_t> views;
  VoxelPlane<int32_t> label;
  VoxelPlane<int16_t> votes;

  explicit VoxelPlanes(const int64_t* const* planes)
      : VoxelPlanes(planes, kVoxels * (4 + (planes[2] ? 4 : 0) + (planes[3] ? 2 : 0) + (planes[4] ? 4 : 0) +
                                       (planes[5] ? 2 : 0))) {}

 private:
  VoxelPlanes(const int64_t* const* planes, int64_t stride)
      : tsdf{planes[0], stride},
        weight{planes[1], stride},
        color{planes[2], stride},
        views{planes[3], stride},
        label{planes[4], stride},
        votes{planes[5], stride} {}
};

}  // namespace pc::tsdf
