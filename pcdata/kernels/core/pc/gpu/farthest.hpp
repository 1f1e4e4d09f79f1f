// Farthest point sampling, exact: each pick is the point farthest from all picks before it, the lowest row among
// equals.
//
// Every thread keeps the distances of its own points. A pick is the greatest of all keys: the bits of a squared
// distance plus 1, which ascend as the distance does, above the row counted down; 0 for a point that was picked.
#pragma once

#include "pc/gpu/rows.hpp"

namespace pc::gpu {

constexpr int kMostWarps = 32;  // of a block

// A cloud under way.
struct Sampling {
  const float* points;  // its first row
  int64_t rows, width;  // columns
  float* nearest;       // (rows): the squared distance to the nearest pick, -1 for a pick itself

  PC_HD float squared_to(int64_t row, int64_t other) const {
    const float *p = points + row * width, *q = points + other * width;
    float total = 0;
    for (int64_t axis = 0; axis < width; ++axis) {
      const float offset = p[axis] - q[axis];
      total = axis == 0 ? offset * offset : total + offset * offset;
    }
    return total;
  }

  // Take note of a pick; return the greatest key of the rows first, first + step, ...
  PC_HD uint64_t after(int64_t pick, bool is_first, int64_t first, int64_t step) const {
    uint64_t best = 0;
    for (int64_t row = first; row < rows; row += step) {
      float kept = is_first ? float_of(0x7F800000u) : nearest[row];
      const float squared = squared_to(row, pick);
      kept = row == pick ? -1.0f : squared < kept ? squared : kept;
      nearest[row] = kept;
      const uint64_t key =
          kept < 0 ? 0 : (static_cast<uint64_t>(bits_of(kept)) + 1) << 32 | (0xFFFFFFFFu - static_cast<uint32_t>(row));
      best = key > best ? key : best;
    }
    return best;
  }
  // The first row where none is left to be picked: a cloud that has fewer points than are asked of it.
  PC_HD static int64_t row_of(uint64_t key) {
    return key == 0 ? 0 : 0xFFFFFFFFu - static_cast<uint32_t>(key & 0xFFFFFFFFu);
  }
};

// The greatest key of a block, in every thread. `table` has room for the warps of a block; two take turns.
PC_HD uint64_t block_max(uint64_t key, uint64_t* table) {
  key = warp_max(key);
  if (lane() == 0) table[thread_in_block() / PC_WARP] = key;
  sync_block();
  for (int warp = 0; warp < block_size() / PC_WARP; ++warp) key = table[warp] > key ? table[warp] : key;
  return key;
}

// One block for each cloud: `counts` (clouds) picks of it, written from picks_ptr[cloud] on as rows of the batch.
PC_BLOCK_KERNEL(pc_sample_clouds, const float* points, const int64_t* ptr, int64_t width, const int64_t* picks_ptr,
                float* nearest, int64_t* picks) {
  PC_SHARED(uint64_t, tables, 2 * kMostWarps);
  const int64_t cloud = block_index(), begin = ptr[cloud];
  const Sampling sampling{points + begin * width, ptr[cloud + 1] - begin, width, nearest + begin};
  const int64_t count = picks_ptr[cloud + 1] - picks_ptr[cloud];
  int64_t pick = 0;
  for (int64_t i = 0; i < count; ++i) {
    if (thread_in_block() == 0) picks[picks_ptr[cloud] + i] = begin + pick;
    if (i + 1 == count) break;
    const uint64_t best = sampling.after(pick, i == 0, thread_in_block(), block_size());
    pick = Sampling::row_of(block_max(best, tables + i % 2 * kMostWarps));
  }
}

// All blocks for one cloud: `count` picks, written from `begin` on. `best` (count) and `arrivals` (1) start as 0.
PC_GRID_KERNEL(pc_sample_cloud, const float* points, int64_t width, int64_t begin, const int64_t* ptr, int64_t cloud,
               int64_t count, float* nearest, uint64_t* best, uint32_t* arrivals, int64_t* picks) {
  PC_SHARED(uint64_t, tables, 2 * kMostWarps);
  const int64_t first = ptr[cloud];
  const Sampling sampling{points + first * width, ptr[cloud + 1] - first, width, nearest + first};
  int64_t pick = 0;
  for (int64_t i = 0; i < count; ++i) {
    if (thread_index() == 0) picks[begin + i] = first + pick;
    if (i + 1 == count) break;
    const uint64_t own =
        block_max(sampling.after(pick, i == 0, thread_index(), thread_count()), tables + i % 2 * kMostWarps);
    if (thread_in_block() == 0) atomic_max(best + i, own);
    sync_grid(arrivals);
    pick = Sampling::row_of(fresh(best + i));
  }
}

}  // namespace pc::gpu
