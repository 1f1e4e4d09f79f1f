// The plane of each cloud that most of its points lie on, found where the points are: nobody asks the host how many
// there are, which hypothesis is best, or whether a refinement has settled.
//
// Numbers are those of the reference, but for the eigenvectors of covariances, which differ in their last digits.
#pragma once

#include "pc/gpu/rows.hpp"
#include "pc/math/eigen.hpp"
#include "pc/math/plane.hpp"

namespace pc::gpu {

// The plane through three rows of each cloud that random words of 32 bits choose, (3, tries): `planes` (clouds, tries,
// 4) and the same in floats; NaN where there is none.
PC_KERNEL(pc_draw_planes, const float* points, const int64_t* ptr, int64_t clouds, const int64_t* words, int64_t tries,
          double flat, double* planes, float* rounded) {
  const int64_t i = thread_index();
  if (i >= clouds * tries) return;
  const int64_t begin = ptr[i / tries], count = ptr[i / tries + 1] - begin;
  double* plane = planes + 4 * i;
  if (count < 3) {
    for (int k = 0; k < 4; ++k) plane[k] = nan("");
  } else {
    int64_t rows[3];
    for (int taken = 0; taken < 3; ++taken) rows[taken] = words[taken * tries + i % tries] % (count - taken);
    rows[1] += rows[1] >= rows[0];  // each skips over those before it
    const int64_t low = rows[0] < rows[1] ? rows[0] : rows[1], high = rows[0] < rows[1] ? rows[1] : rows[0];
    rows[2] += rows[2] >= low;
    rows[2] += rows[2] >= high;
    const float* own = points + 3 * begin;
    math::plane_through(math::vector_of(own + 3 * rows[0]), math::vector_of(own + 3 * rows[1]),
                        math::vector_of(own + 3 * rows[2]), flat, plane);
  }
  for (int k = 0; k < 4; ++k) rounded[4 * i + k] = static_cast<float>(plane[k]);
}

// Pick 2^bits points of each cloud that has more, one of each of as many stretches, and all of another; side by side.
PC_KERNEL(pc_spread_points, const float* points, const int64_t* ptr, int64_t clouds, int64_t bits, float* spread,
          int64_t* spread_ptr) {
  const int64_t most = int64_t{1} << bits, cloud = thread_index() >> bits, number = thread_index() & (most - 1);
  if (cloud >= clouds) return;
  int64_t first = 0;
  for (int64_t other = 0; other < cloud; ++other) {
    const int64_t size = ptr[other + 1] - ptr[other];
    first += size < most ? size : most;
  }
  const int64_t begin = ptr[cloud], size = ptr[cloud + 1] - begin, some = size < most ? size : most;
  if (number == 0) {
    if (cloud == 0) spread_ptr[0] = 0;
    spread_ptr[cloud + 1] = first + some;
  }
  if (number >= some) return;
  int64_t row = begin + number;
  if (size > most) {
    const int64_t edge = begin + (number * size >> bits), next = begin + ((number + 1) * size >> bits);
    row = edge + ((number * 2654435769 & 0xFFFFFFFF) * (next - edge) >> 32);
  }
  for (int axis = 0; axis < 3; ++axis) spread[3 * (first + number) + axis] = points[3 * row + axis];
}

// The plane of each cloud with the greatest of the counts (clouds, tries), the first of equals; a warp for each. With
// `missed`, the logarithm of how likely a better plane may be missed, those behind the last try that this needs do not
// count; 0: all do. `failed` (1) is set where no plane has three points; `ptr` is that of the points counted.
PC_BLOCK_KERNEL(pc_choose_planes, const int32_t* counts, const double* planes, int64_t tries, const int64_t* ptr,
                double missed, double* chosen, int32_t* failed) {
  const int64_t cloud = block_index();
  const double size = static_cast<double>(ptr[cloud + 1] - ptr[cloud]), infinity = 1e300;
  int32_t best = 0;
  int64_t winner = 0;
  double needed = infinity;
  bool is_over = false;
  for (int64_t first = 0; first < tries && !is_over; first += PC_WARP) {
    const int32_t count = first + lane() < tries ? counts[cloud * tries + first + lane()] : 0;
    for (uint32_t better = ballot(count > best); better != 0 && !is_over; better = ballot(count > best)) {
      const int at = lowest_bit(better);
      if (static_cast<double>(first + at) >= needed) break;
      best = from_lane(count, at);
      winner = first + at;
      const double share = static_cast<double>(best) / size;
      if (missed < 0) needed = missed / log1p(-(share * share * share));
      is_over = static_cast<double>(winner + 1) >= needed;
    }
    is_over = is_over || static_cast<double>(first + PC_WARP) >= needed;
  }
  if (lane() != 0) return;
  if (best < 3) *failed = 1;
  for (int k = 0; k < 4; ++k) chosen[4 * cloud + k] = planes[4 * (cloud * tries + winner) + k];
}

PC_HD math::Plane rounded_plane(const double* p) {
  return {static_cast<float>(p[0]), static_cast<float>(p[1]), static_cast<float>(p[2]), static_cast<float>(p[3])};
}

// Number of points near, number of those near one of the two planes alone, first and second moments about the cloud's
// first point, largest coordinate.
constexpr int kFitSums = 12;

// Sum up the points near the plane that is tried for each cloud, beside the one it has: `sums` (clouds, blocks,
// kFitSums), in one order. Nothing where none is tried: NaN.
PC_BLOCK_KERNEL(pc_sum_near_planes, const float* points, const int64_t* ptr, int64_t blocks, const double* planes,
                const double* tried, double distance, double* sums) {
  PC_SHARED(double, of_warps, kFitSums * 32);
  const int64_t cloud = block_index() / blocks, part = block_index() % blocks;
  const math::Plane plane = rounded_plane(tried + 4 * cloud), before = rounded_plane(planes + 4 * cloud);
  const float reach = static_cast<float>(distance);
  const float* origin = points + 3 * ptr[cloud];
  const int64_t end = plane.x == plane.x ? ptr[cloud + 1] : 0;
  double own[kFitSums] = {};
  for (int64_t row = ptr[cloud] + part * block_size() + thread_in_block(); row < end; row += blocks * block_size()) {
    const float* point = points + 3 * row;
    const bool is_near = plane.is_near(point, reach);
    own[1] += is_near != before.is_near(point, reach) ? 1 : 0;
    if (!is_near) continue;
    const double x = static_cast<double>(point[0]) - static_cast<double>(origin[0]),
                 y = static_cast<double>(point[1]) - static_cast<double>(origin[1]),
                 z = static_cast<double>(point[2]) - static_cast<double>(origin[2]);
    const double terms[9] = {x, y, z, x * x, x * y, x * z, y * y, y * z, z * z};
    own[0] += 1;
    for (int i = 0; i < 9; ++i) own[2 + i] += terms[i];
    for (int axis = 0; axis < 3; ++axis)
      own[kFitSums - 1] = math::larger(own[kFitSums - 1], fabs(static_cast<double>(point[axis])));
  }
  for (int i = 0; i < kFitSums; ++i) {
    for (int step = PC_WARP / 2; step > 0; step /= 2) {
      const double other = from_lane(own[i], lane() ^ step);
      own[i] = i + 1 < kFitSums ? own[i] + other : math::larger(own[i], other);
    }
    if (lane() == 0) of_warps[thread_in_block() / PC_WARP * kFitSums + i] = own[i];
  }
  sync_block();
  const int sum = thread_in_block();
  if (sum >= kFitSums) return;
  double total = 0;
  for (int warp = 0; warp < block_size() / PC_WARP; ++warp) {
    const double value = of_warps[warp * kFitSums + sum];
    total = sum + 1 < kFitSums ? total + value : math::larger(total, value);
  }
  sums[block_index() * kFitSums + sum] = total;
}

// The least-squares plane of what was summed up about an origin; NaN for a line, or fewer than three points.
PC_HD void fit_plane(const double* total, const float* origin, double flat, double* plane) {
  const double count = total[0] > 1 ? total[0] : 1;
  const math::Vector3 mean{total[2] / count, total[3] / count, total[4] / count};
  const math::Symmetric3 covariance{total[5] / count - mean.x * mean.x, total[6] / count - mean.x * mean.y,
                                    total[7] / count - mean.x * mean.z, total[8] / count - mean.y * mean.y,
                                    total[9] / count - mean.y * mean.z, total[10] / count - mean.z * mean.z};
  const math::LeastVarying found = math::least_varying(covariance);
  if (total[0] < 3 || sqrt(found.next > 0 ? found.next : 0) <= flat * total[kFitSums - 1]) {
    for (int k = 0; k < 4; ++k) plane[k] = nan("");
    return;
  }
  const math::Vector3 n = found.direction;
  plane[0] = n.x;
  plane[1] = n.y;
  plane[2] = n.z;
  plane[3] = -((n.x * (origin[0] + mean.x) + n.z * (origin[2] + mean.z)) + n.y * (origin[1] + mean.y));
}

// Take the plane that was tried for each cloud, unless too few points are near it, and fit the next to try while the
// points near it change; `is_open` (clouds) says so. With `is_first` it is that of the search.
PC_KERNEL(pc_refit_planes, const float* points, const int64_t* ptr, int64_t clouds, int64_t blocks, const double* sums,
          double flat, int64_t is_first, double* planes, double* tried, int32_t* is_open) {
  const int64_t cloud = thread_index();
  if (cloud >= clouds) return;
  double total[kFitSums] = {};
  for (int64_t block = 0; block < blocks; ++block)
    for (int i = 0; i < kFitSums; ++i) {
      const double value = sums[(cloud * blocks + block) * kFitSums + i];
      total[i] = i + 1 < kFitSums ? total[i] + value : math::larger(total[i], value);
    }
  double *own = tried + 4 * cloud, *plane = planes + 4 * cloud;
  const bool is_taken = is_first || (is_open[cloud] && own[0] == own[0] && total[0] >= 3);
  for (int k = 0; is_taken && k < 4; ++k) plane[k] = own[k];
  is_open[cloud] = is_taken && (is_first || total[1] > 0);
  if (is_open[cloud])
    fit_plane(total, points + 3 * ptr[cloud], flat, own);
  else
    for (int k = 0; k < 4; ++k) own[k] = nan("");
}

// Mark the points near their cloud's plane.
PC_KERNEL(pc_mark_near, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows, const double* planes,
          double distance, uint8_t* near) {
  const int64_t row = thread_index();
  if (row >= filled(ptr, clouds, rows)) return;
  near[row] =
      rounded_plane(planes + 4 * cloud_of(ptr, clouds, row)).is_near(points + 3 * row, static_cast<float>(distance));
}

}  // namespace pc::gpu
