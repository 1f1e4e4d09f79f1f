// The blocks of a truncated signed distance field on a GPU: where their voxels lie, and the table that finds a block.
#pragma once

#include "pc/gpu/thread.hpp"
#include "pc/math/voxel_block.hpp"

namespace pc::gpu {

using math::BlockPlace;
using math::kEdge;
using math::kSlab;
using math::kVoxels;

// Rows of blocks by their keys, as the CPU's core has them: open addressing, at most half full, a place holds a row or
// -1. Which row lies where depends on the order of threads; what is found does not.
#define PC_TABLE_PARAMETERS const int64_t *keys, int32_t *places, int64_t mask, int64_t shift

struct RowTable {
  const int64_t* keys;  // of all rows
  int32_t* places;      // (mask + 1); null: there are no blocks
  int64_t mask, shift;  // 2^(64 - shift) places

  PC_HD void add(int64_t row) const {
    int64_t at = math::first_place(keys[row], static_cast<int>(shift));
    while (atomic_swap_if(places + at, -1, static_cast<int32_t>(row)) != -1) at = (at + 1) & mask;
  }
  PC_HD int64_t find(int64_t key) const {
    if (places == nullptr) return -1;
    int64_t at = math::first_place(key, static_cast<int>(shift));
    for (;; at = (at + 1) & mask) {
      const int32_t row = places[at];
      if (row < 0 || keys[row] == key) return row;
    }
  }
  // The block so many blocks away.
  PC_HD int64_t find_beside(int64_t key, int x, int y, int z) const {
    const BlockPlace block = BlockPlace::of(key), beside{block.x + x, block.y + y, block.z + z};
    return beside.is_within() ? find(beside.key()) : -1;
  }
};

PC_KERNEL(pc_add_blocks, PC_TABLE_PARAMETERS, int64_t first, int64_t end) {
  const int64_t row = first + thread_index();
  if (row < end) RowTable{keys, places, mask, shift}.add(row);
}

PC_KERNEL(pc_find_blocks, PC_TABLE_PARAMETERS, const int64_t* wanted, int64_t count, int64_t* rows) {
  const int64_t i = thread_index();
  if (i < count) rows[i] = RowTable{keys, places, mask, shift}.find(wanted[i]);
}

// The planes of all blocks: chunks of blocks, each block one stretch of memory, plane after plane.
#define PC_PLANES_PARAMETERS const int64_t *chunks, int64_t held

struct VoxelPlanes {
  static constexpr int64_t kChunk = 8192;  // blocks
  static constexpr int64_t kColor = 1, kViews = 2, kLabel = 4;
  static constexpr int64_t kNarrow = 2 * kVoxels, kWide = 4 * kVoxels;  // bytes of a plane

  const int64_t* chunks;  // address of each
  int64_t held;           // kColor | kViews | kLabel: the planes that there are besides distances and weights

  PC_HD bool has(int64_t plane) const { return (held & plane) != 0; }
  PC_HD char* block(int64_t row) const {
    const int64_t bytes = after_views() + (has(kLabel) ? kWide + kNarrow : 0);
    return reinterpret_cast<char*>(chunks[row / kChunk]) + row % kChunk * bytes;
  }
  PC_HD int16_t* tsdf(char* block) const { return reinterpret_cast<int16_t*>(block); }
  PC_HD int16_t* weight(char* block) const { return reinterpret_cast<int16_t*>(block + kNarrow); }
  PC_HD int32_t* color(char* block) const { return reinterpret_cast<int32_t*>(block + 2 * kNarrow); }
  PC_HD int16_t* views(char* block) const { return reinterpret_cast<int16_t*>(block + after_color()); }
  PC_HD int32_t* label(char* block) const { return reinterpret_cast<int32_t*>(block + after_views()); }
  PC_HD int16_t* votes(char* block) const { return reinterpret_cast<int16_t*>(block + after_views() + kWide); }

 private:
  PC_HD int64_t after_color() const { return 2 * kNarrow + (has(kColor) ? kWide : 0); }
  PC_HD int64_t after_views() const { return after_color() + (has(kViews) ? kNarrow : 0); }
};

}  // namespace pc::gpu
