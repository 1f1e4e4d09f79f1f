// Rows of ragged clouds: cloud b is rows ptr[b] to ptr[b+1]. Arrays may have room for more rows than the clouds fill,
// so that their sizes are known where the number of rows is not: what lies behind the last row is finite and means
// nothing.
#pragma once

#include "pc/gpu/thread.hpp"
#include "pc/math/distance.hpp"

namespace pc::gpu {

// A point with its row, in an order other than that of the rows.
struct alignas(16) Placed {
  float x, y, z;
  int32_t row;
};

// The cloud of a row.
PC_HD int64_t cloud_of(const int64_t* ptr, int64_t clouds, int64_t row) {
  int64_t low = 0, high = clouds;  // ptr[low] <= row < ptr[high]
  while (high - low > 1) {
    const int64_t middle = (low + high) / 2;
    if (ptr[middle] <= row)
      low = middle;
    else
      high = middle;
  }
  return low;
}

// How many rows the clouds fill of those that arrays have room for.
PC_HD int64_t filled(const int64_t* ptr, int64_t clouds, int64_t room) {
  return ptr[clouds] < room ? ptr[clouds] : room;
}

PC_HD float squared_between(const float* points, int64_t a, int64_t b) {
  const float *p = points + 3 * a, *q = points + 3 * b;
  return math::squared_distance(p[0], p[1], p[2], q[0], q[1], q[2]);
}

}  // namespace pc::gpu
