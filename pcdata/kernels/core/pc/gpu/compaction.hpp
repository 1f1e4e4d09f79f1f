// Rows that are kept, moved together within arrays of the same size.
#pragma once

#include "pc/gpu/rows.hpp"

namespace pc::gpu {

// Move the rows that `keep` marks to the front, those behind the last become 0; `ends` (rows) is the running total of
// the marks. `kept_ptr` (clouds + 1) is where the clouds then begin.
PC_KERNEL(pc_move_kept, const float* points, const int64_t* source, const uint8_t* keep, const int32_t* ends,
          const int64_t* ptr, int64_t clouds, int64_t rows, float* kept_points, int64_t* kept_source,
          int64_t* kept_ptr) {
  const int64_t row = thread_index(), all = filled(ptr, clouds, rows);
  if (row <= clouds) kept_ptr[row] = ptr[row] > 0 ? ends[ptr[row] - 1] : 0;
  if (row >= rows) return;
  if (row >= (all > 0 ? ends[all - 1] : 0)) {
    for (int axis = 0; axis < 3; ++axis) kept_points[3 * row + axis] = 0;
    kept_source[row] = 0;
  }
  if (row >= all || !keep[row]) return;
  const int64_t place = ends[row] - 1;
  for (int axis = 0; axis < 3; ++axis) kept_points[3 * place + axis] = points[3 * row + axis];
  kept_source[place] = source[row];
}

}  // namespace pc::gpu
