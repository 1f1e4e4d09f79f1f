// Points in cells so small that all points of one are neighbors.
//
// A cell's side is the radius over sqrt(3), less a margin, and its coordinates count from the first point of its cloud,
// so they need no bounds.
#pragma once

#include "pc/gpu/table.hpp"

namespace pc::gpu {

// Farther out than this the coordinates of a cloud may be 2^36 cells apart, where they are no longer trusted.
constexpr double kFarCell = 34359738368.0;  // 2^35

struct NeighborCells {
  const float* points;  // (N, 3)
  const int64_t* ptr;   // (clouds + 1)
  int64_t clouds;
  double side;

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

 private:
  PC_HD static int64_t whole(double value) {
    const double most = 1099511627776.0;  // 2^40: far out, see kFarCell
    return static_cast<int64_t>(floor(value > most ? most : value < -most ? -most : value));
  }
};

using Cells = Table<NeighborCells>;

// Put every row into its cell: its place in the table, and how many of that cell came before it; both are skipped if
// `needed` (1,) is 0. The places of cells are listed, `num_listed` (1,) of them. Sets `far` (1,) if a point lies so far
// out that its cell is not certain.
PC_KERNEL(pc_insert_cells, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows, double side,
          uint64_t* places, int64_t mask, const int32_t* needed, int32_t* place_of, int32_t* rank_of, int32_t* counts,
          int32_t* listed, int32_t* num_listed, int32_t* far) {
  const int64_t row = thread_index();
  if (row >= filled(ptr, clouds, rows) || *needed == 0) return;
  const Cells cells{{points, ptr, clouds, side}, places, mask};
  const int64_t cloud = cloud_of(ptr, clouds, row);
  if (cells.grid.is_far(cloud, points + 3 * row)) *far = 1;
  bool is_new = false;
  const int64_t place = cells.insert(cells.grid.cell_of(cloud, points + 3 * row), row, is_new);
  if (is_new) listed[atomic_add(num_listed, 1)] = static_cast<int32_t>(place);
  place_of[row] = static_cast<int32_t>(place);
  rank_of[row] = atomic_add(counts + place, 1);
}

// Lay the points of each cell side by side: those of a place end where `ends`, the running total of counts, says.
PC_KERNEL(pc_place_points, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows, const int32_t* needed,
          const int32_t* place_of, const int32_t* rank_of, const int32_t* counts, const int32_t* ends, float* placed) {
  const int64_t row = thread_index();
  if (row >= filled(ptr, clouds, rows) || *needed == 0) return;
  const int32_t place = place_of[row];
  const float* p = points + 3 * row;
  reinterpret_cast<Placed*>(placed)[ends[place] - counts[place] + rank_of[row]] = {p[0], p[1], p[2],
                                                                                   static_cast<int32_t>(row)};
}

}  // namespace pc::gpu
