// Points near planes: counted for many planes at once, and summed up to fit one plane anew.
#pragma once

#include "pc/gpu/rows.hpp"
#include "pc/math/plane.hpp"

namespace pc::gpu {

constexpr int kTile = 512;          // points that a block looks at together
constexpr int kPlanesOfThread = 4;  // so that a point is read once for so many

// Add to `counts` (clouds, planes) the points nearer than `distance` to each plane of their cloud; `planes` is
// (clouds, num_planes, 4), NaN where none are to be counted. A cloud is shared by `blocks` blocks.
PC_BLOCK_KERNEL(pc_count_near_planes, const float* points, const int64_t* ptr, int64_t blocks, const float* planes,
                int64_t num_planes, double distance, int32_t* counts) {
  PC_SHARED(float, tile, 3 * kTile);
  const int64_t cloud = block_index() / blocks, part = block_index() % blocks;
  const int64_t begin = ptr[cloud], end = ptr[cloud + 1];
  const float reach = static_cast<float>(distance);
  for (int64_t first = 0; first < num_planes; first += kPlanesOfThread * block_size()) {
    math::Plane own[kPlanesOfThread];
    int32_t found[kPlanesOfThread];
    for (int i = 0; i < kPlanesOfThread; ++i) {
      const int64_t plane = first + i * block_size() + thread_in_block();
      const float* p = planes + 4 * (cloud * num_planes + (plane < num_planes ? plane : 0));
      own[i] = {p[0], p[1], p[2], p[3]};
      found[i] = 0;
    }
    for (int64_t start = begin + part * kTile; start < end; start += blocks * kTile) {
      const int size = static_cast<int>(end - start < kTile ? end - start : kTile);
      sync_block();  // all have read the tile before
      for (int i = thread_in_block(); i < 3 * size; i += block_size()) tile[i] = points[3 * start + i];
      sync_block();
      for (int i = 0; i < size; ++i) {
        const float point[3] = {tile[3 * i], tile[3 * i + 1], tile[3 * i + 2]};
        for (int j = 0; j < kPlanesOfThread; ++j) found[j] += own[j].is_near(point, reach) ? 1 : 0;
      }
    }
    for (int i = 0; i < kPlanesOfThread; ++i) {
      const int64_t plane = first + i * block_size() + thread_in_block();
      if (plane < num_planes && found[i] > 0) atomic_add(counts + cloud * num_planes + plane, found[i]);
    }
  }
}

// Number of points near, number that differ from before, first and second moments about the origin, largest coordinate.
constexpr int kPlaneSums = 12;

// Mark the points near one plane of each cloud, and sum them up: `sums` (clouds, blocks, kPlaneSums). Clouds whose
// plane is NaN are left alone. The sums of a block are taken in one order.
PC_BLOCK_KERNEL(pc_mark_near_plane, const float* points, const int64_t* ptr, int64_t blocks, const float* planes,
                double distance, const double* origins, const uint8_t* before, uint8_t* near, double* sums) {
  PC_SHARED(double, of_warps, kPlaneSums * 32);
  const int64_t cloud = block_index() / blocks, part = block_index() % blocks;
  const float* p = planes + 4 * cloud;
  const math::Plane plane{p[0], p[1], p[2], p[3]};
  const bool is_plane = plane.x == plane.x;
  double own[kPlaneSums] = {};
  for (int64_t row = ptr[cloud] + part * block_size() + thread_in_block(); is_plane && row < ptr[cloud + 1];
       row += blocks * block_size()) {
    const float* point = points + 3 * row;
    const bool is_near = plane.is_near(point, static_cast<float>(distance));
    near[row] = is_near;
    own[1] += is_near != (before[row] != 0) ? 1 : 0;
    if (!is_near) continue;
    const double x = static_cast<double>(point[0]) - origins[3 * cloud],
                 y = static_cast<double>(point[1]) - origins[3 * cloud + 1],
                 z = static_cast<double>(point[2]) - origins[3 * cloud + 2];
    const double terms[9] = {x, y, z, x * x, x * y, x * z, y * y, y * z, z * z};
    own[0] += 1;
    for (int i = 0; i < 9; ++i) own[2 + i] += terms[i];
    for (int axis = 0; axis < 3; ++axis)
      own[kPlaneSums - 1] = math::larger(own[kPlaneSums - 1], fabs(static_cast<double>(point[axis])));
  }
  for (int i = 0; i < kPlaneSums; ++i) {
    for (int step = PC_WARP / 2; step > 0; step /= 2) {
      const double other = from_lane(own[i], lane() ^ step);
      own[i] = i + 1 < kPlaneSums ? own[i] + other : math::larger(own[i], other);
    }
    if (lane() == 0) of_warps[thread_in_block() / PC_WARP * kPlaneSums + i] = own[i];
  }
  sync_block();
  const int sum = thread_in_block();
  if (sum >= kPlaneSums) return;
  double total = 0;
  for (int warp = 0; warp < block_size() / PC_WARP; ++warp) {
    const double value = of_warps[warp * kPlaneSums + sum];
    total = sum + 1 < kPlaneSums ? total + value : math::larger(total, value);
  }
  sums[block_index() * kPlaneSums + sum] = total;
}

}  // namespace pc::gpu
