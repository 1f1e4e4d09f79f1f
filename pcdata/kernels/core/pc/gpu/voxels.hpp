// Means of the points in each voxel of a regular grid: a hash table numbers the voxels, sums are whole numbers, so
// neither the order of threads nor the device changes a bit.
#pragma once

#include "pc/gpu/table.hpp"

namespace pc::gpu {

// Numbers that are ordered as the floats are.
PC_HD int32_t ordered(float value) {
  const int32_t bits = static_cast<int32_t>(bits_of(value));
  return bits < 0 ? bits ^ 0x7FFFFFFF : bits;
}

// The lowest corner of each cloud, (clouds, 3) as ordered numbers, which start as the largest. A warp takes `stride`
// rows.
PC_BLOCK_KERNEL(pc_find_corners, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows, int64_t stride,
                int32_t* corners) {
  const int64_t begin = thread_index() / PC_WARP * stride, end = begin + stride < rows ? begin + stride : rows;
  if (begin >= rows) return;  // all of a warp
  const int64_t first_cloud = cloud_of(ptr, clouds, begin);
  if (end <= ptr[first_cloud + 1]) {
    for (int axis = 0; axis < 3; ++axis) {
      int32_t least = 0x7FFFFFFF;
      for (int64_t row = begin + lane(); row < end; row += PC_WARP) {
        const int32_t value = ordered(points[3 * row + axis]);
        least = value < least ? value : least;
      }
      least = warp_min(least);
      if (lane() == 0) atomic_min(corners + 3 * first_cloud + axis, least);
    }
    return;
  }
  for (int64_t row = begin + lane(); row < end; row += PC_WARP) {
    const int64_t cloud = cloud_of(ptr, clouds, row);
    for (int axis = 0; axis < 3; ++axis) atomic_min(corners + 3 * cloud + axis, ordered(points[3 * row + axis]));
  }
}

struct Voxels {
  const float* points;  // (N, 3)
  const int64_t* ptr;   // (clouds + 1)
  int64_t clouds;
  const double* origins;  // (clouds, 3)
  const double* edges;    // (clouds, 3)

  // Where a point lies, counted in voxels from the origin of its cloud.
  PC_HD double scaled(int64_t cloud, int64_t row, int axis) const {
    return (static_cast<double>(points[3 * row + axis]) - origins[3 * cloud + axis]) / edges[3 * cloud + axis];
  }
  PC_HD Cell cell_of(int64_t cloud, int64_t row) const {
    return {cloud, {whole(scaled(cloud, row, 0)), whole(scaled(cloud, row, 1)), whole(scaled(cloud, row, 2))}};
  }
  PC_HD Cell cell_of(int64_t row) const { return cell_of(cloud_of(ptr, clouds, row), row); }

  static constexpr double kMost = 9007199254740992.0;  // 2^53: doubles no longer tell neighboring voxels apart

 private:
  PC_HD static int64_t whole(double value) {
    return static_cast<int64_t>(floor(value > kMost ? kMost : value < -kMost ? -kMost : value));
  }
};

// Find each row's voxel, and the lowest row of each. Sets `far` (1,) if a point lies 2^53 voxels out.
PC_KERNEL(pc_insert_voxels, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows,
          const double* origins, const double* edges, uint64_t* places, int64_t mask, int32_t* place_of,
          int32_t* lowest, int32_t* far) {
  const int64_t row = thread_index();
  if (row >= rows) return;
  const Table<Voxels> voxels{{points, ptr, clouds, origins, edges}, places, mask};
  const int64_t cloud = cloud_of(ptr, clouds, row);
  for (int axis = 0; axis < 3; ++axis)
    if (!(fabs(voxels.grid.scaled(cloud, row, axis)) < Voxels::kMost)) *far = 1;
  bool is_new = false;
  const int64_t place = voxels.insert(voxels.grid.cell_of(cloud, row), row, is_new);
  place_of[row] = static_cast<int32_t>(place);
  atomic_min(lowest + place, static_cast<int32_t>(row));
}

PC_KERNEL(pc_mark_first_of_voxels, int64_t rows, const int32_t* place_of, const int32_t* lowest, int32_t* is_first) {
  const int64_t row = thread_index();
  if (row < rows) is_first[row] = lowest[place_of[row]] == row;
}

// Sum up where points lie within their voxels, in parts of 2^-31; `begun` (N,) is the running total of the firsts.
PC_KERNEL(pc_sum_voxels, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows, const double* origins,
          const double* edges, const int32_t* place_of, const int32_t* lowest, const int64_t* begun, int64_t* inverse,
          int64_t* sums, int64_t* members) {
  const int64_t row = thread_index();
  if (row >= rows) return;
  const Voxels voxels{points, ptr, clouds, origins, edges};
  const int64_t cloud = cloud_of(ptr, clouds, row), number = begun[lowest[place_of[row]]] - 1;
  inverse[row] = number;
  atomic_add(members + number, int64_t{1});
  for (int axis = 0; axis < 3; ++axis) {
    const double scaled = voxels.scaled(cloud, row, axis);
    atomic_add(sums + 3 * number + axis, static_cast<int64_t>(rint((scaled - floor(scaled)) * math::kFixedPoint)));
  }
}

// Write the mean of each voxel, with the reference's operations.
PC_KERNEL(pc_average_voxels, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows,
          const double* origins, const double* edges, const int32_t* is_first, const int64_t* begun,
          const int64_t* sums, const int64_t* members, float* means) {
  const int64_t row = thread_index();
  if (row >= rows || !is_first[row]) return;
  const Voxels voxels{points, ptr, clouds, origins, edges};
  const int64_t cloud = cloud_of(ptr, clouds, row), number = begun[row] - 1;
  for (int axis = 0; axis < 3; ++axis) {
    const double offset =
        static_cast<double>(sums[3 * number + axis]) / static_cast<double>(members[number]) / math::kFixedPoint;
    means[3 * number + axis] = static_cast<float>(
        origins[3 * cloud + axis] + (floor(voxels.scaled(cloud, row, axis)) + offset) * edges[3 * cloud + axis]);
  }
}

}  // namespace pc::gpu
