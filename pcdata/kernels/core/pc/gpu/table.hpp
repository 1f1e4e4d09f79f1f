// A hash table of the cells, or voxels, that are occupied: open addressing, as many places as a power of two.
//
// A place holds the first row to arrive in its cell and part of the cell's hash; whether a cell is the one looked for
// is asked of that row, so coordinates of any size and any number of clouds are exact. Which row arrives first differs
// from run to run; no result may depend on it.
#pragma once

#include "pc/gpu/rows.hpp"
#include "pc/math/voxel.hpp"

namespace pc::gpu {

struct Cell {
  int64_t cloud;
  math::WideVoxel at;

  PC_HD bool operator==(const Cell& other) const { return cloud == other.cloud && at == other.at; }
  PC_HD uint64_t hash() const {
    return math::PackedVoxel::mixed(at.hash() ^ (at.hash() >> 29) ^ static_cast<uint64_t>(cloud));
  }
};

// Grid: what says `cell_of(row)`.
template <class Grid>
struct Table {
  Grid grid;
  uint64_t* places;  // (mask + 1): the row + 1 and, above it, 32 bits of the hash; 0 = free
  int64_t mask;      // their number, less 1

  // The place of a row's cell, taken if the cell has none; `is_new` says so.
  PC_HD int64_t insert(const Cell& cell, int64_t row, bool& is_new) const {
    const uint64_t hash = cell.hash(), own = marked(hash, row);
    for (int64_t place = first(hash);; place = (place + 1) & mask) {
      uint64_t held = fresh(places + place);
      if (held == 0) held = atomic_swap_if(places + place, uint64_t{0}, own);
      is_new = held == 0;
      if (is_new || holds(held, own, cell)) return place;
    }
  }
  // The place of a cell, -1 if it has none.
  PC_HD int64_t find(const Cell& cell) const {
    const uint64_t hash = cell.hash(), own = marked(hash, 0);
    for (int64_t place = first(hash);; place = (place + 1) & mask) {
      const uint64_t held = places[place];
      if (held == 0) return -1;
      if (holds(held, own, cell)) return place;
    }
  }

 private:
  PC_HD static uint64_t marked(uint64_t hash, int64_t row) { return hash << 32 | static_cast<uint64_t>(row + 1); }
  PC_HD int64_t first(uint64_t hash) const { return static_cast<int64_t>(hash >> 24) & mask; }
  PC_HD bool holds(uint64_t held, uint64_t own, const Cell& cell) const {
    return held >> 32 == own >> 32 && grid.cell_of(static_cast<int64_t>(held & 0xFFFFFFFFu) - 1) == cell;
  }
};

}  // namespace pc::gpu
