// Which points have too few neighbors within a radius.
#pragma once

#include "pc/gpu/cell_table.hpp"

namespace pc::gpu {

// Count neighbors among the rows stored next to each row, which is mostly enough for what comes from a depth image.
// `outlier` (N,) is 1 where that decides nothing; these rows are listed in `undecided` (N,), `count` (1,) of them.
PC_KERNEL(pc_count_beside, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows, double limit,
          int64_t enough, int64_t reach, uint8_t* outlier, int32_t* undecided, int32_t* count) {
  const int64_t row = thread_index();
  if (row >= filled(ptr, clouds, rows)) return;
  const float below = static_cast<float>(limit);
  const int64_t cloud = cloud_of(ptr, clouds, row), begin = ptr[cloud], end = ptr[cloud + 1];
  int64_t found = 0.0f < below ? 1 : 0;  // itself
  for (int64_t step = 1; step <= reach && found <= enough; ++step) {
    if (row - step >= begin && squared_between(points, row, row - step) < below) ++found;
    if (row + step < end && squared_between(points, row, row + step) < below) ++found;
  }
  outlier[row] = found <= enough;
  if (found <= enough) undecided[atomic_add(count, 1)] = static_cast<int32_t>(row);
}

// Whether no point of a cell that many cells away along each axis can be within the radius of a point at these
// fractions of its own cell. The radius is sqrt(3) / (1 - 1e-4) sides; borders and distances err by far less than what
// is allowed here.
PC_HD bool is_out_of_reach(const double* fraction, int dx, int dy, int dz) {
  const int step[3] = {dx, dy, dz};
  double squared = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const double gap = step[axis] > 0   ? step[axis] - fraction[axis]
                       : step[axis] < 0 ? fraction[axis] - step[axis] - 1
                                        : 0;
    squared += gap * gap;
  }
  return squared > 3.01;
}

constexpr int kCellReach = 2;  // ceil(sqrt(3)), and a margin

// The neighbors of a row, up to one more than enough, in the cells around its own: those that touch it first.
PC_HD int64_t count_in_cells(const Cells& cells, const int32_t* counts, const int32_t* ends, const Placed* placed,
                             int64_t row, float below, int64_t enough) {
  const float* point = cells.grid.points + 3 * row;
  const Cell home = cells.grid.cell_of(row);
  const double fraction[3] = {cells.grid.coordinate(home.cloud, point, 0) - static_cast<double>(home.at.x),
                              cells.grid.coordinate(home.cloud, point, 1) - static_cast<double>(home.at.y),
                              cells.grid.coordinate(home.cloud, point, 2) - static_cast<double>(home.at.z)};
  int64_t found = 0;
  for (int shell = 0; shell <= kCellReach && found <= enough; ++shell)
    for (int dx = -shell; dx <= shell && found <= enough; ++dx)
      for (int dy = -shell; dy <= shell && found <= enough; ++dy)
        for (int dz = -shell; dz <= shell && found <= enough; ++dz) {
          const bool is_inside = dx > -shell && dx < shell && dy > -shell && dy < shell && dz > -shell && dz < shell;
          if ((shell > 0 && is_inside) || is_out_of_reach(fraction, dx, dy, dz)) continue;
          const int64_t place = cells.find({home.cloud, {home.at.x + dx, home.at.y + dy, home.at.z + dz}});
          if (place < 0) continue;
          for (int32_t i = ends[place] - counts[place]; i < ends[place] && found <= enough; ++i)
            if (math::squared_distance(point[0], point[1], point[2], placed[i].x, placed[i].y, placed[i].z) < below)
              ++found;
        }
  return found;
}

// Decide the rows that are listed.
PC_KERNEL(pc_count_around, const float* points, const int64_t* ptr, int64_t clouds, double side, uint64_t* places,
          int64_t mask, const int32_t* counts, const int32_t* ends, const float* placed, double limit, int64_t enough,
          const int32_t* undecided, const int32_t* count, const int32_t* place_of, uint8_t* outlier) {
  const Cells cells{{points, ptr, clouds, side}, places, mask};
  for (int64_t i = thread_index(); i < *count; i += thread_count()) {
    const int64_t row = undecided[i];
    if (counts[place_of[row]] > enough || count_in_cells(cells, counts, ends, reinterpret_cast<const Placed*>(placed),
                                                         row, static_cast<float>(limit), enough) > enough)
      outlier[row] = 0;
  }
}

}  // namespace pc::gpu
