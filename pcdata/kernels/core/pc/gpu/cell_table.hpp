// Points in cells so small that all points of one are neighbors: a hash table of the cells that are occupied.
//
// A cell's side is the radius over sqrt(3), less a margin, and its coordinates count from the first point of its cloud,
// so they need no bounds. A place of the table holds its cell's first row to arrive and part of its hash; whether a
// cell is the one looked for is asked of that row, so coordinates of any size and any number of clouds are exact.
// The order of arrival differs from run to run; no result may depend on it.
#pragma once

#include "pc/gpu/rows.hpp"
#include "pc/math/voxel.hpp"

namespace pc::gpu {

// Farther out than this the coordinates of a cloud may be 2^36 cells apart, where they are no longer trusted.
constexpr double kFarCell = 34359738368.0;  // 2^35

struct Cell {
  int64_t cloud;
  math::WideVoxel at;

  PC_HD bool operator==(const Cell& other) const { return cloud == other.cloud && at == other.at; }
  PC_HD uint64_t hash() const {
    return math::PackedVoxel::mixed(at.hash() ^ (at.hash() >> 29) ^ static_cast<uint64_t>(cloud));
  }
};

struct Cells {
  const float* points;  // (N, 3)
  const int64_t* ptr;   // (clouds + 1)
  int64_t clouds;
  double side;
  uint64_t* places;  // (mask + 1): the row + 1 and, above it, 32 bits of the hash; 0 = free
  int64_t mask;      // their number, a power of two, less 1

  // Where a point lies, counted in cells from the first point of its cloud.
  PC_HD double coordinate(int64_t cloud, const float* point, int axis) const {
    return (static_cast<double>(point[axis]) - static_cast<double>(points[3 * ptr[cloud] + axis])) / side;
  }
  PC_HD Cell cell_of(int64_t cloud, const float* point) const {
    return {
        cloud,
        {whole(coordinate(cloud, point, 0)), whole(coordinate(cloud, point, 1)), whole(coordinate(cloud, point, 2))}};
  }
  PC_HD Cell cell_of(int64_t row) const { return cell_of(cloud_of(ptr, clouds, row), points + 3 * row); }
  PC_HD bool is_far(int64_t cloud, const float* point) const {
    for (int axis = 0; axis < 3; ++axis)
      if (!(fabs(coordinate(cloud, point, axis)) < kFarCell)) return true;
    return false;
  }

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
  PC_HD static int64_t whole(double value) {
    const double most = 1099511627776.0;  // 2^40: far out, see kFarCell
    value = value > most ? most : value < -most ? -most : value;
    const int64_t towards_zero = static_cast<int64_t>(value);
    return towards_zero - (static_cast<double>(towards_zero) > value ? 1 : 0);
  }
  PC_HD static uint64_t marked(uint64_t hash, int64_t row) { return hash << 32 | static_cast<uint64_t>(row + 1); }
  PC_HD int64_t first(uint64_t hash) const { return static_cast<int64_t>(hash >> 24) & mask; }
  PC_HD bool holds(uint64_t held, uint64_t own, const Cell& cell) const {
    return held >> 32 == own >> 32 && cell_of(static_cast<int64_t>(held & 0xFFFFFFFFu) - 1) == cell;
  }
};

// Put every row into its cell: its place in the table, and how many of that cell came before it; both are skipped if
// `needed` (1,) is 0. The places of cells are listed, `num_listed` (1,) of them. Sets `far` (1,) if a point lies so far
// out that its cell is not certain.
PC_KERNEL(pc_insert_cells, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows, double side,
          uint64_t* places, int64_t mask, const int32_t* needed, int32_t* place_of, int32_t* rank_of, int32_t* counts,
          int32_t* listed, int32_t* num_listed, int32_t* far) {
  const int64_t row = thread_index();
  if (row >= rows || *needed == 0) return;
  const Cells cells{points, ptr, clouds, side, places, mask};
  const int64_t cloud = cloud_of(ptr, clouds, row);
  if (cells.is_far(cloud, points + 3 * row)) *far = 1;
  bool is_new = false;
  const int64_t place = cells.insert(cells.cell_of(cloud, points + 3 * row), row, is_new);
  if (is_new) listed[atomic_add(num_listed, 1)] = static_cast<int32_t>(place);
  place_of[row] = static_cast<int32_t>(place);
  rank_of[row] = atomic_add(counts + place, 1);
}

// Lay the points of each cell side by side: those of a place end where `ends`, the running total of counts, says.
PC_KERNEL(pc_place_points, const float* points, int64_t rows, const int32_t* needed, const int32_t* place_of,
          const int32_t* rank_of, const int32_t* counts, const int32_t* ends, float* placed) {
  const int64_t row = thread_index();
  if (row >= rows || *needed == 0) return;
  const int32_t place = place_of[row];
  const float* p = points + 3 * row;
  reinterpret_cast<Placed*>(placed)[ends[place] - counts[place] + rank_of[row]] = {p[0], p[1], p[2],
                                                                                   static_cast<int32_t>(row)};
}

}  // namespace pc::gpu
