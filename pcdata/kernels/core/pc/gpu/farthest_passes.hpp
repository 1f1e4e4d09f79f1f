// Farthest point sampling of one large cloud, several exact picks between two meetings of all blocks.
//
// Points lie in the order of a curve, so each block has a tile that is compact. Between meetings a block notes the
// picks in its tile and publishes its candidate: the point of its tile that is farthest from all picks, and how far the
// rest of the tile is at most once the candidate is picked too. Then every block draws the same picks from what all
// have published: the best candidate is the next pick, and the one after it, as long as no pick since lies nearer to it
// than those before and no tile that may hold a better point is in doubt. Keys are those of farthest.hpp, so ties go by
// rows.
#pragma once

#include "pc/gpu/farthest.hpp"
#include "pc/math/bounds.hpp"

namespace pc::gpu {

constexpr int kMostTiles = 1024, kMostPicks = 64;  // between two meetings

PC_HD float kept_of(uint64_t key) { return float_of(static_cast<uint32_t>(key >> 32) - 1); }

PC_HD uint64_t key_of_kept(float kept, int64_t row) {
  return kept < 0 ? 0 : (static_cast<uint64_t>(bits_of(kept)) + 1) << 32 | (0xFFFFFFFFu - static_cast<uint32_t>(row));
}

PC_HD float squared_to(const Placed& p, const float* other) {
  return math::squared_distance(p.x, p.y, p.z, other[0], other[1], other[2]);
}

// All blocks for one cloud whose points lie in order at `placed`: `count` picks, written from `begin` on. `nearest` has
// room for the cloud's places; `keys` and `rests` are (2, blocks), `spots` (2, blocks, 3); `arrivals` (1) starts as 0.
// At most kMostTiles blocks.
PC_GRID_KERNEL(pc_sample_in_passes, const float* points, const float* placed, const int64_t* ptr, int64_t cloud,
               int64_t begin, int64_t count, float* nearest, uint64_t* keys, uint64_t* rests, float* spots,
               uint32_t* arrivals, int64_t* picks) {
  PC_SHARED(uint64_t, tables, 2 * kMostWarps);
  PC_SHARED(uint64_t, bounds, kMostTiles);
  PC_SHARED(uint8_t, known, kMostTiles);
  PC_SHARED(float, places, 3 * kMostPicks);
  PC_SHARED(int64_t, rows, kMostPicks);
  PC_SHARED(float, spot, 3);
  PC_SHARED(int32_t, number, 1);
  const int64_t first = ptr[cloud], size = ptr[cloud + 1] - first, tiles = block_count();
  const int64_t each = (size + tiles - 1) / tiles, own = first + block_index() * each;
  const int64_t end = own + each < first + size ? own + each : first + size;
  const Placed* sorted = reinterpret_cast<const Placed*>(placed);
  if (thread_in_block() == 0) {
    number[0] = 1;
    rows[0] = 0;
    for (int axis = 0; axis < 3; ++axis) places[axis] = size > 0 ? points[3 * first + axis] : 0;
  }
  sync_block();
  int64_t done = 0;
  for (int pass = 0;; ++pass) {
    const int some = number[0];
    if (block_index() == 0)
      for (int i = thread_in_block(); i < some; i += block_size()) picks[begin + done + i] = first + rows[i];
    done += some;
    if (done >= count) return;
    uint64_t best = 0;
    for (int64_t i = own + thread_in_block(); i < end; i += block_size()) {
      const Placed p = sorted[i];
      const int64_t row = p.row - first;
      float kept = pass == 0 ? float_of(0x7F800000u) : nearest[i];
      for (int k = 0; k < some; ++k) {
        const float squared = squared_to(p, places + 3 * k);
        kept = row == rows[k] || kept < 0 ? -1.0f : squared < kept ? squared : kept;
      }
      nearest[i] = kept;
      const uint64_t key = key_of_kept(kept, row);
      best = key > best ? key : best;
    }
    best = block_max(best, tables);
    for (int64_t i = own + thread_in_block(); i < end; i += block_size())
      if (best != 0 && sorted[i].row - first == Sampling::row_of(best)) {
        spot[0] = sorted[i].x;
        spot[1] = sorted[i].y;
        spot[2] = sorted[i].z;
      }
    sync_block();
    uint64_t rest = 0;
    for (int64_t i = own + thread_in_block(); best != 0 && i < end; i += block_size()) {
      const int64_t row = sorted[i].row - first;
      const float squared = squared_to(sorted[i], spot), kept = nearest[i];
      const uint64_t key = row == Sampling::row_of(best) ? 0 : key_of_kept(squared < kept ? squared : kept, row);
      rest = key > rest ? key : rest;
    }
    rest = block_max(rest, tables + kMostWarps);
    const int64_t turn = pass % 2 * tiles;  // those of the pass before are still being read
    if (thread_in_block() == 0) {
      keys[turn + block_index()] = best;
      rests[turn + block_index()] = rest;
      for (int axis = 0; axis < 3; ++axis) spots[3 * (turn + block_index()) + axis] = best != 0 ? spot[axis] : 0;
    }
    sync_grid(arrivals);
    for (int64_t tile = thread_in_block(); tile < tiles; tile += block_size()) {
      bounds[tile] = fresh(keys + turn + tile);
      known[tile] = 1;
    }
    sync_block();
    if (thread_in_block() < PC_WARP) {
      int drawn = 0;
      while (drawn < kMostPicks && done + drawn < count) {
        uint64_t greatest = 0;
        int64_t at = 0;
        for (int64_t tile = lane(); tile < tiles; tile += PC_WARP)
          if (bounds[tile] > greatest) {
            greatest = bounds[tile];
            at = tile;
          }
        const uint64_t all = warp_max(greatest);
        const int from = lowest_bit(ballot(greatest == all));
        const int64_t winner = from_lane(at, from);
        if (drawn > 0 && (all == 0 || !known[winner])) break;
        float place[3];
        for (int axis = 0; axis < 3; ++axis) place[axis] = fresh(spots + 3 * (turn + winner) + axis);
        sync_warp();  // all have read what is written now
        if (lane() == 0) {
          rows[drawn] = Sampling::row_of(all);
          for (int axis = 0; axis < 3; ++axis) places[3 * drawn + axis] = place[axis];
          bounds[winner] = fresh(rests + turn + winner);
          known[winner] = 0;
        }
        sync_warp();
        for (int64_t tile = lane(); tile < tiles; tile += PC_WARP) {
          if (!known[tile] || bounds[tile] == 0) continue;
          float other[3];
          for (int axis = 0; axis < 3; ++axis) other[axis] = fresh(spots + 3 * (turn + tile) + axis);
          const float squared = math::squared_distance(other[0], other[1], other[2], place[0], place[1], place[2]);
          if (squared < kept_of(bounds[tile])) known[tile] = 0;
        }
        sync_warp();
        ++drawn;
      }
      if (lane() == 0) number[0] = drawn;
    }
    sync_block();
  }
}

}  // namespace pc::gpu
