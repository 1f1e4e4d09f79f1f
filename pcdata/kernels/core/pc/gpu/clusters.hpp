// DBSCAN in cells: the core points of one cell are one cluster, so only cells need joining.
//
// Components are trees of places in the table of cells; a root stands for its component, and which place that is may
// differ from run to run. Clusters are numbered by their lowest core row, which does not.
//
// Source: cells as in Gunawan, A faster algorithm for DBSCAN, 2013; joining as in Jaiganesh & Burtscher, A
// high-performance connected components implementation for GPUs, HPDC 2018.
#pragma once

#include "pc/gpu/radius.hpp"

namespace pc::gpu {

// The root of a component; paths are halved on the way.
PC_HD int32_t root_of(int32_t* parents, int32_t place) {
  for (;;) {
    const int32_t parent = fresh(parents + place), above = fresh(parents + parent);
    if (parent == above) return parent;
    atomic_swap_if(parents + place, parent, above);  // another thread may have done so
    place = above;
  }
}

// Make two components one; the lower root stays.
PC_HD void join(int32_t* parents, int32_t a, int32_t b) {
  for (;;) {
    a = root_of(parents, a);
    b = root_of(parents, b);
    if (a == b) return;
    const int32_t low = a < b ? a : b, high = a < b ? b : a;
    if (atomic_swap_if(parents + high, high, low) == high) return;
  }
}

// Mark the rows with at least `wanted` points within reach, and start every component as one cell.
PC_KERNEL(pc_mark_cores, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows, double side,
          uint64_t* places, int64_t mask, const int32_t* counts, const int32_t* ends, const float* placed, double limit,
          int64_t wanted, const int32_t* place_of, uint8_t* core, int32_t* core_counts, int32_t* parents) {
  const int64_t i = thread_index();
  if (i >= rows) return;
  const Cells cells{{points, ptr, clouds, side}, places, mask};
  const Placed* sorted = reinterpret_cast<const Placed*>(placed);
  const int64_t row = sorted[i].row;  // neighboring threads look at the same cells
  const int32_t place = place_of[row];
  const bool is_core = counts[place] >= wanted || count_in_cells(cells, counts, ends, sorted, row,
                                                                 static_cast<float>(limit), wanted - 1) >= wanted;
  core[row] = is_core;
  if (is_core) atomic_add(core_counts + place, 1);
  parents[place] = place;
}

// Whether a core point of one cell is within reach of a core point of another. Every lane of a warp calls.
PC_HD bool touch(const int32_t* counts, const int32_t* ends, const Placed* placed, const uint8_t* core, int32_t a,
                 int32_t b, float below) {
  for (int32_t first = ends[a] - counts[a]; first < ends[a]; first += PC_WARP) {
    const int32_t own = first + lane();
    const bool is_core = own < ends[a] && core[placed[own].row];
    const Placed p = placed[own < ends[a] ? own : first];
    bool found = false;
    for (int32_t i = ends[b] - counts[b]; i < ends[b]; ++i) {
      if (is_core && core[placed[i].row] &&
          math::squared_distance(p.x, p.y, p.z, placed[i].x, placed[i].y, placed[i].z) < below)
        found = true;
      if ((i & 7) == 7 && ballot(found) != 0) return true;
    }
    if (ballot(found) != 0) return true;
  }
  return false;
}

// Join the cells that hold core points within reach of each other; a warp for each of the cells that are listed.
PC_BLOCK_KERNEL(pc_join_cells, const float* points, const int64_t* ptr, int64_t clouds, double side, uint64_t* places,
                int64_t mask, const int32_t* counts, const int32_t* ends, const float* placed, double limit,
                const int32_t* listed, const int32_t* num_listed, const uint8_t* core, const int32_t* core_counts,
                int32_t* parents) {
  const Cells cells{{points, ptr, clouds, side}, places, mask};
  const Placed* sorted = reinterpret_cast<const Placed*>(placed);
  for (int64_t i = thread_index() / PC_WARP; i < *num_listed; i += thread_count() / PC_WARP) {
    const int32_t place = listed[i];
    if (core_counts[place] == 0) continue;
    const Cell home = cells.grid.cell_of(sorted[ends[place] - 1].row);
    for (int shell = 1; shell <= kCellReach; ++shell)
      for (int dx = 0; dx <= shell; ++dx)
        for (int dy = dx > 0 ? -shell : 0; dy <= shell; ++dy)
          for (int dz = dx > 0 || dy > 0 ? -shell : 1; dz <= shell; ++dz) {
            if (dx < shell && dy > -shell && dy < shell && dz > -shell && dz < shell) continue;  // of the shell before
            const int64_t other = cells.find({home.cloud, {home.at.x + dx, home.at.y + dy, home.at.z + dz}});
            if (other < 0 || core_counts[other] == 0) continue;
            const int32_t found = static_cast<int32_t>(other);
            // Lanes may see different roots while others join: lane 0 decides for all.
            const bool is_joined = lane() == 0 && root_of(parents, place) == root_of(parents, found);
            if (ballot(is_joined) != 0) continue;
            if (touch(counts, ends, sorted, core, place, found, static_cast<float>(limit)) && lane() == 0)
              join(parents, place, found);
          }
  }
}

// The lowest core row of each component; `lowest` (places) starts as the largest number.
PC_KERNEL(pc_find_lowest_cores, int64_t rows, const uint8_t* core, const int32_t* place_of, int32_t* parents,
          int32_t* lowest) {
  const int64_t row = thread_index();
  if (row >= rows || !core[row]) return;
  atomic_min(lowest + root_of(parents, place_of[row]), static_cast<int32_t>(row));
}

// Mark the rows that are the lowest of their clusters.
PC_KERNEL(pc_mark_firsts, int64_t rows, const uint8_t* core, const int32_t* place_of, int32_t* parents,
          const int32_t* lowest, int32_t* is_first) {
  const int64_t row = thread_index();
  if (row >= rows) return;
  is_first[row] = core[row] && lowest[root_of(parents, place_of[row])] == row;
}

// The cluster of a cell that holds core points: how many clusters of its cloud begin before its own.
PC_HD int64_t cluster_of(int32_t place, int64_t begin, int32_t* parents, const int32_t* lowest, const int64_t* begun) {
  return begun[lowest[root_of(parents, place)]] - 1 - (begin > 0 ? begun[begin - 1] : 0);
}

// Label every row; `begun` (N,) is the running total of the firsts. A border takes the lowest label in its reach.
PC_KERNEL(pc_label_rows, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows, double side,
          uint64_t* places, int64_t mask, const int32_t* counts, const int32_t* ends, const float* placed, double limit,
          const int32_t* place_of, const uint8_t* core, const int32_t* core_counts, int32_t* parents,
          const int32_t* lowest, const int64_t* begun, int64_t* label) {
  const int64_t at = thread_index();
  if (at >= rows) return;
  const Cells cells{{points, ptr, clouds, side}, places, mask};
  const Placed* sorted = reinterpret_cast<const Placed*>(placed);
  const int64_t row = sorted[at].row, begin = ptr[cloud_of(ptr, clouds, row)];
  if (core[row]) {
    label[row] = cluster_of(place_of[row], begin, parents, lowest, begun);
    return;
  }
  const float below = static_cast<float>(limit);
  const float* point = points + 3 * row;
  const Cell home = cells.grid.cell_of(row);
  int64_t least = -1;
  for (int dx = -kCellReach; dx <= kCellReach; ++dx)
    for (int dy = -kCellReach; dy <= kCellReach; ++dy)
      for (int dz = -kCellReach; dz <= kCellReach; ++dz) {
        const int64_t place = cells.find({home.cloud, {home.at.x + dx, home.at.y + dy, home.at.z + dz}});
        if (place < 0 || core_counts[place] == 0) continue;
        const int64_t cluster = cluster_of(static_cast<int32_t>(place), begin, parents, lowest, begun);
        if (least >= 0 && cluster >= least) continue;
        for (int32_t i = ends[place] - counts[place]; i < ends[place]; ++i)
          if (core[sorted[i].row] &&
              math::squared_distance(point[0], point[1], point[2], sorted[i].x, sorted[i].y, sorted[i].z) < below) {
            least = cluster;
            break;
          }
      }
  label[row] = least;
}

}  // namespace pc::gpu
