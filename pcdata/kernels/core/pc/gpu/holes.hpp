// Holes of depth images, filled from the readings beside them.
#pragma once

#include "pc/gpu/depth_filters.hpp"

namespace pc::gpu {

// Layers of holes, counted from the rims: 0 for readings.
constexpr int32_t kWaiting = 0x7FFFFFFE, kNeverFilled = 0x7FFFFFFF;

// Copy the last reading of the row into the holes behind it, but for those that `wide` (or null) marks.
PC_KERNEL(pc_fill_from_left, const float* depth, int64_t count, int64_t width, const uint8_t* wide, float* filled,
          int32_t* layers) {
  const int64_t i = thread_index();
  if (i >= count) return;
  const int64_t begin = i - i % width;
  int64_t at = i;
  while (at > begin && !(depth[at] > 0) && (wide == nullptr || wide[at] == 0)) --at;
  const bool reaches = at < i && depth[at] > 0;
  filled[i] = reaches ? depth[at] : depth[i];
  layers[i] = reaches ? static_cast<int32_t>(i - at) : 0;
}

// Fill up to `radius` pixels of every gap in a row from its left side, then as many from its right side.
PC_KERNEL(pc_fill_gaps, const float* values, int64_t count, int64_t width, int64_t radius, float* filled) {
  const int64_t i = thread_index();
  if (i >= count) return;
  const int64_t column = i % width, left = column < radius ? column : radius;
  const int64_t right = width - 1 - column < radius ? width - 1 - column : radius;
  float found = values[i];
  for (int64_t step = 1; step <= left && !(found > 0); ++step) found = values[i - step];
  for (int64_t step = 1; step <= right && !(found > 0); ++step) found = values[i + step];
  filled[i] = found;
}

// The pixels of depth images that are filled inwards from the rims of their holes.
struct Filling {
  int64_t height, width;
  float* values;
  int32_t* layers;
  int32_t* queue;  // all pixels that are filled, layer by layer

  // Call body(pixel) for up to four neighbors within the image.
  template <class Body>
  PC_HD void around(int64_t pixel, Body&& body) const {
    const int64_t row = pixel / width % height, column = pixel % width;
    if (row > 0) body(pixel - width);
    if (column > 0) body(pixel - 1);
    if (column + 1 < width) body(pixel + 1);
    if (row + 1 < height) body(pixel + width);
  }
};

// Copy the images, and call up the first layer, the holes beside a reading; `counts` (3,) starts as 0.
PC_KERNEL(pc_begin_filling, const float* depth, int64_t count, int64_t height, int64_t width, const uint8_t* wide,
          float* values, int32_t* layers, int32_t* queue, int32_t* counts) {
  const int64_t i = thread_index();
  if (i >= count) return;
  const bool is_hole = !(depth[i] > 0), never = is_hole && wide != nullptr && wide[i] != 0;
  bool beside = false;
  Filling{height, width, values, layers, queue}.around(i, [&](int64_t other) { beside = beside || depth[other] > 0; });
  const bool is_first = is_hole && !never && beside;
  values[i] = depth[i];
  layers[i] = never ? kNeverFilled : !is_hole ? 0 : is_first ? 1 : kWaiting;
  if (is_first) queue[atomic_add(counts + 1, 1)] = static_cast<int32_t>(i);
}

// Fill layer after layer: the pixels of one take the farthest, or nearest, depth of those of the layers before, and
// call up the next. A neighbor that is called meanwhile, seen or not, is of no layer before.
PC_GRID_KERNEL(pc_fill_layers, int64_t height, int64_t width, int64_t farthest, float* values, int32_t* layers,
               int32_t* queue, int32_t* counts, uint32_t* arrivals) {
  const Filling filling{height, width, values, layers, queue};
  int64_t begin = 0;
  for (int32_t layer = 1;; ++layer) {
    const int64_t size = fresh(counts + layer % 3);
    if (size == 0) return;
    const int64_t end = begin + size;
    int32_t* next = counts + (layer + 1) % 3;
    if (thread_index() == 0) counts[(layer + 2) % 3] = 0;
    for (int64_t i = begin + thread_index(); i < end; i += thread_count()) {
      const int64_t pixel = fresh(queue + i);
      float chosen = 0;
      filling.around(pixel, [&](int64_t other) {
        if (fresh(layers + other) < layer) {
          const float offered = fresh(values + other);
          if (!(chosen > 0) || (farthest != 0 ? offered > chosen : offered < chosen)) chosen = offered;
        } else if (atomic_swap_if(layers + other, kWaiting, layer + 1) == kWaiting) {
          queue[end + atomic_add(next, 1)] = static_cast<int32_t>(other);
        }
      });
      values[pixel] = chosen;
    }
    begin = end;
    sync_grid(arrivals);
  }
}

// How far each pixel lies from the reading that it copies, or whether that is above a limit; either may be null.
PC_KERNEL(pc_tell_distances, int64_t count, const int32_t* layers, int64_t limit, int64_t* distance, uint8_t* far) {
  const int64_t i = thread_index();
  if (i >= count) return;
  const int64_t steps = layers[i] < kWaiting ? layers[i] : 0;
  if (distance != nullptr) distance[i] = steps;
  if (far != nullptr) far[i] = steps > limit;
}

// The confidence of depths after some were filled, `far` (or null) from a reading; sets `any_filled` (1,).
PC_KERNEL(pc_trust_filled, const float* before, const float* after, int64_t count, const uint8_t* confidence,
          const uint8_t* far, uint8_t* found, int32_t* any_filled) {
  const int64_t i = thread_index();
  if (i >= count) return;
  const bool is_filled = before[i] == 0 && after[i] > 0;
  const int was = confidence != nullptr ? confidence[i] : before[i] > 0 ? 3 : 0;
  found[i] = static_cast<uint8_t>(is_filled ? (far != nullptr && far[i] != 0 ? 1 : 2) : was);
  if (is_filled) *any_filled = 1;
}

}  // namespace pc::gpu
