// The blocks that a depth image touches, each once.
//
// Neighboring pixels touch the same blocks: a thread leaves to the one on its left what that one touches too, a block
// of threads, which looks at a tile of the image, keeps what it met in shared memory, and what is left goes into a
// table in global memory. Lists come in the order of arrival; whoever reads them sorts them.
#pragma once

#include "pc/gpu/tsdf_table.hpp"

namespace pc::gpu {

constexpr int kTileWidth = PC_WARP, kTileHeight = 8;  // pixels, a thread each
constexpr int kMet = 1024;                            // places of what a tile has met
constexpr int kMostOffsets = 33;                      // a truncation of 64 voxels, in halves of a block, both ways
constexpr int kMetProbes = 8;                         // then it counts as not met

// What a view says of the way of its rays through blocks, as doubles that hold float32 and whole numbers.
struct RaysInBlocks {
  float turn[9], fraction[3];  // world from camera, in blocks per meter; where the camera is, in its block
  int64_t camera[3];           // the block that it is in

  PC_HD explicit RaysInBlocks(const double* numbers) {
    for (int i = 0; i < 9; ++i) turn[i] = static_cast<float>(numbers[i]);
    for (int a = 0; a < 3; ++a) fraction[a] = static_cast<float>(numbers[9 + a]);
    for (int a = 0; a < 3; ++a) camera[a] = static_cast<int64_t>(numbers[12 + a]);
  }
  PC_HD float along(int axis, float x, float y) const {
    return (turn[3 * axis] * x + turn[3 * axis + 1] * y) + turn[3 * axis + 2];
  }
};

// Counters: an error, how many blocks have no row yet, how many were touched by all views so far, and by each view.
enum Counter { kFar, kFull, kMissing, kTouched, kOfViews };

struct TouchedTable {
  uint64_t* places;  // (mask + 1): the key + 1; 0 = free
  int32_t* stamps;   // of each place: the last view that touched it, counted from 1
  int64_t mask, probes;
  RowTable rows;
  int64_t *touched, *missing;  // (mask + 1) keys
  int32_t* counters;

  PC_HD void touch(uint64_t marked, int32_t view) const {
    const int64_t key = static_cast<int64_t>(marked) - 1;
    int64_t place = static_cast<int64_t>(math::PackedVoxel::mixed(marked) >> 24) & mask;
    for (int64_t probe = 0;; ++probe, place = (place + 1) & mask) {
      if (probe == probes) {
        counters[kFull] = 1;
        return;
      }
      uint64_t held = fresh(places + place);
      if (held == 0) held = atomic_swap_if(places + place, uint64_t{0}, marked);
      if (held == 0 && rows.find(key) < 0) missing[atomic_add(counters + kMissing, 1)] = key;
      if (held == 0 || held == marked) break;
    }
    if (fresh(stamps + place) >= view || atomic_max(stamps + place, view) >= view) return;
    const int32_t at = atomic_add(counters + kTouched, 1);
    if (at <= mask)
      touched[at] = key;
    else
      counters[kFull] = 1;
    atomic_add(counters + kOfViews + view - 1, 1);
  }
};

// Whether a tile meets a key for the first time; sometimes it says so of one that it met before.
PC_HD bool is_new_to_tile(uint64_t* met, uint64_t marked) {
  uint32_t place = static_cast<uint32_t>(math::PackedVoxel::mixed(marked) >> 54);
  for (int probe = 0; probe < kMetProbes; ++probe, place = (place + 1) % kMet) {
    uint64_t held = fresh(met + place);
    if (held == 0) held = atomic_swap_if(met + place, uint64_t{0}, marked);
    if (held == 0) return true;
    if (held == marked) return false;
  }
  return true;
}

// A block of threads for each tile; along each ray 2 * halves + 1 places, from one truncation in front to one behind.
PC_BLOCK_KERNEL(pc_touch_blocks, const float* depth, const float* rays, int64_t height, int64_t width,
                const double* numbers, double truncation, int64_t halves, int64_t view, uint64_t* table,
                int32_t* stamps, int64_t table_mask, int64_t probes, PC_TABLE_PARAMETERS, int64_t* touched,
                int64_t* missing, int32_t* counters) {
  PC_SHARED(uint64_t, met, kMet);
  PC_SHARED(float, offsets, kMostOffsets);
  for (int i = thread_in_block(); i < kMet; i += block_size()) met[i] = 0;
  for (int i = thread_in_block(); i <= 2 * halves; i += block_size())
    offsets[i] = static_cast<float>(truncation * static_cast<double>(i - halves) / static_cast<double>(halves));
  sync_block();
  const TouchedTable found{table, stamps, table_mask, probes, {keys, places, mask, shift}, touched, missing, counters};
  const RaysInBlocks view_rays(numbers);
  const int64_t across = (width + kTileWidth - 1) / kTileWidth;
  const int64_t u = block_index() % across * kTileWidth + thread_in_block() % kTileWidth;
  const int64_t v = block_index() / across * kTileHeight + thread_in_block() / kTileWidth;
  const bool is_inside = u < width && v < height;
  const int64_t pixel = is_inside ? v * width + u : 0;
  const float reading = is_inside ? depth[pixel] : 0.0f, x = rays[pixel], y = rays[height * width + pixel];
  uint64_t before = 0;  // what the offset before has touched
  for (int step = 0; step <= 2 * halves; ++step) {
    const float z = reading + offsets[step];
    uint64_t own = 0;
    if (reading > 0 && z > 0) {
      int64_t at[3];
      for (int axis = 0; axis < 3; ++axis) {
        const float place = floorf(view_rays.along(axis, x, y) * z + view_rays.fraction[axis]);
        const bool is_whole = fabsf(place) < 1e12f;  // else it is far beyond all blocks, or not a number
        at[axis] = is_whole ? static_cast<int64_t>(place) + view_rays.camera[axis] : math::kBlocksPerSide;
      }
      const BlockPlace block{at[0], at[1], at[2]};
      if (block.is_within())
        own = static_cast<uint64_t>(block.key()) + 1;
      else
        counters[kFar] = 1;
    }
    const uint64_t left = from_lane(own, lane() > 0 ? lane() - 1 : 0);
    const bool is_left_s = lane() > 0 && own == left;
    if (own != 0 && own != before && !is_left_s && is_new_to_tile(met, own))
      found.touch(own, static_cast<int32_t>(view) + 1);
    before = own;
  }
}

}  // namespace pc::gpu
