// Points that are moved, jittered, cut out: what augmentation does to ragged batches, each row once.
#pragma once

#include "pc/gpu/rows.hpp"
#include "pc/math/affine.hpp"
#include "pc/math/random.hpp"

namespace pc::gpu {

PC_HD math::Point point_at(const float* points, int64_t row) {
  return {points[3 * row], points[3 * row + 1], points[3 * row + 2]};
}
PC_HD void put_point(float* points, int64_t row, math::Point p) {
  points[3 * row] = p.x;
  points[3 * row + 1] = p.y;
  points[3 * row + 2] = p.z;
}

// Every 64 rows of a cloud have 96 words of its stream, 32 of each axis in turn; see pcdata/functional/noise.py.
PC_HD float jittered(float value, uint64_t seed, int64_t row, int axis, float sigma, float most) {
  const int64_t number = row / 64 * 96 + row % 32 + 32 * axis;
  const math::NormalPair pair = math::NormalPair::of(math::random_word(seed, static_cast<uint64_t>(number)));
  float change = (row % 64 < 32 ? pair.one : pair.other) * sigma;
  change = change > most ? most : change;
  change = change < -most ? -most : change;
  return value + change;
}

// Take points through steps, rounded after each. `rules` (steps, 3): whether a step is noise, its deviation and largest
// change; `numbers` (steps, clouds, 16): a matrix, or the bits of a seed. With `ends`, the running total of rows that
// `kept` marks, those alone are written.
PC_KERNEL(pc_take_through, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows, int64_t steps,
          const double* rules, const double* numbers, const uint8_t* kept, const int64_t* ends, float* moved) {
  const int64_t row = thread_index();
  if (row >= rows || (kept != nullptr && kept[row] == 0)) return;
  const int64_t cloud = cloud_of(ptr, clouds, row);
  math::Point p = point_at(points, row);
  for (int64_t step = 0; step < steps; ++step) {
    const double *rule = rules + 3 * step, *own = numbers + 16 * (step * clouds + cloud);
    if (rule[0] == 0) {
      p = math::Affine(own)(p);
      continue;
    }
    const uint64_t seed = *reinterpret_cast<const uint64_t*>(own);
    const float sigma = static_cast<float>(rule[1]), most = static_cast<float>(rule[2]);
    const int64_t number = row - ptr[cloud];
    p = {jittered(p.x, seed, number, 0, sigma, most), jittered(p.y, seed, number, 1, sigma, most),
         jittered(p.z, seed, number, 2, sigma, most)};
  }
  put_point(moved, ends == nullptr ? row : ends[row] - 1, p);
}

// Directions (N, 3) under linear maps (clouds, 3, 3), made unit length; zeros stay zeros.
PC_KERNEL(pc_turn_directions, const float* directions, const int64_t* ptr, int64_t clouds, int64_t rows,
          const double* linear, float* turned) {
  const int64_t row = thread_index();
  if (row >= rows) return;
  const math::Point p = point_at(directions, row);
  const double* m = linear + 9 * cloud_of(ptr, clouds, row);
  const double x = p.x, y = p.y, z = p.z;
  const double a = ((x * m[0] + y * m[1]) + z * m[2]) + 0.0;  // + 0: no negative zeros
  const double b = ((x * m[3] + y * m[4]) + z * m[5]) + 0.0;
  const double c = ((x * m[6] + y * m[7]) + z * m[8]) + 0.0;
  const double length = math::larger(sqrt((a * a + b * b) + c * c), 1e-12);
  put_point(turned, row,
            {static_cast<float>(a / length), static_cast<float>(b / length), static_cast<float>(c / length)});
}

// Which points lie in a box; sets `infinite` (1,) if one is NaN or infinite.
PC_KERNEL(pc_mark_inside, const float* points, int64_t rows, double low_x, double low_y, double low_z, double high_x,
          double high_y, double high_z, uint8_t* inside, int32_t* infinite) {
  const int64_t row = thread_index();
  if (row >= rows) return;
  const math::CropBox box{{static_cast<float>(low_x), static_cast<float>(low_y), static_cast<float>(low_z)},
                          {static_cast<float>(high_x), static_cast<float>(high_y), static_cast<float>(high_z)}};
  const math::Point p = point_at(points, row);
  inside[row] = box.contains(p);
  if (!math::is_finite(p)) *infinite = 1;
}

}  // namespace pc::gpu
