// Where a truncated signed distance field crosses zero along the edges of its grid.
//
// A block of threads for each block of voxels. Marks are a bit per edge: of every 32 voxels, those along x, y and z,
// one word each. They are kept between counting and writing, because most blocks have none.
#pragma once

#include "pc/gpu/tsdf_table.hpp"
#include "pc/math/fusion.hpp"

namespace pc::gpu {

constexpr int kGroups = kVoxels / PC_WARP;  // of 32 voxels
constexpr int kMarks = 3 * kGroups;         // words of a block
constexpr int kUnseen = -32768;             // no stored distance: those end at -32767

struct SortedBlocks {
  const int64_t *keys, *rows;  // keys, rising, and the row of each
  RowTable table;
  VoxelPlanes planes;
};
#define PC_SORTED_PARAMETERS const int64_t *sorted_keys, const int64_t *sorted_rows

// -- counting -----------------------------------------------------------------------------------------------------

// A block and the first voxels of the next ones: voxel (x, y, z) is at x + 9 y + 81 z.
constexpr int kEnds = kEdge + 1;
constexpr int kEndStride[3] = {1, kEnds, kEnds * kEnds};

// Mark the edges that cross zero, their ends both with a weight above `bound`; count them into `counts`, and into
// `dropped` (1,) those of which that is not so. A block of threads for each block, 256 of them.
PC_BLOCK_KERNEL(pc_mark_crossings, PC_SORTED_PARAMETERS, PC_TABLE_PARAMETERS, PC_PLANES_PARAMETERS, int64_t bound,
                uint32_t* marks, int64_t* counts, int64_t* dropped) {
  PC_SHARED(int16_t, tsdf, kEnds * kEnds * kEnds);
  PC_SHARED(int16_t, weight, kEnds * kEnds * kEnds);
  PC_SHARED(int64_t, rows, 8);
  PC_SHARED(int32_t, totals, 2);
  const SortedBlocks field{sorted_keys, sorted_rows, {keys, places, mask, shift}, {chunks, held}};
  const int64_t block = block_index();
  if (thread_in_block() < 8) {  // those without and with a step along x, y, z; only the first four are looked at
    const int c = thread_in_block();
    rows[c] = c == 0 ? field.rows[block] : field.table.find_beside(field.keys[block], c & 1, c >> 1 & 1, c >> 2);
  }
  if (thread_in_block() < 2) totals[thread_in_block()] = 0;
  sync_block();
  for (int i = thread_in_block(); i < kEnds * kEnds * kEnds; i += block_size()) {
    const int x = i % kEnds, y = i / kEnds % kEnds, z = i / (kEnds * kEnds);
    const int64_t row = rows[x / kEdge + 2 * (y / kEdge) + 4 * (z / kEdge)];
    const int voxel = x % kEdge + kEdge * (y % kEdge) + kSlab * (z % kEdge);
    char* const from = row < 0 ? nullptr : field.planes.block(row);
    tsdf[i] = row < 0 ? int16_t{0} : field.planes.tsdf(from)[voxel];
    weight[i] = row < 0 ? int16_t{0} : field.planes.weight(from)[voxel];
  }
  sync_block();
  for (int voxel = thread_in_block(); voxel < kVoxels; voxel += block_size()) {
    const int here = voxel % kEdge + kEnds * (voxel / kEdge % kEdge) + kEnds * kEnds * (voxel / kSlab);
    for (int axis = 0; axis < 3; ++axis) {
      const int there = here + kEndStride[axis];
      const int a = tsdf[here], b = tsdf[there], apart = a < b ? b - a : a - b;
      const int least = weight[here] < weight[there] ? weight[here] : weight[there];
      const bool crosses = least > 0 && (a < 0) != (b < 0) && apart <= 32767;
      const uint32_t kept = ballot(crosses && least > bound), all = bound > 0 ? ballot(crosses) : kept;
      if (lane() != 0) continue;
      marks[block * kMarks + voxel / PC_WARP * 3 + axis] = kept;
      if (kept != 0) atomic_add(totals, count_bits(kept));
      if (all != kept) atomic_add(totals + 1, count_bits(all & ~kept));
    }
  }
  sync_block();
  if (thread_in_block() != 0) return;
  counts[block] = totals[0];
  if (totals[1] > 0) atomic_add(dropped, static_cast<int64_t>(totals[1]));
}

// -- writing ------------------------------------------------------------------------------------------------------

// A block with two voxels before it and three behind: voxel (x, y, z) is at x + 2 + 13 (y + 2) + 169 (z + 2).
constexpr int kBefore = 2, kSide = kBefore + kEdge + 3;
constexpr int kStride[3] = {1, kSide, kSide * kSide};

// The weighted rises of the pairs of seen voxels around a place along an axis, and their steps; see surface.py.
struct Rise {
  int32_t rise, steps;
};

PC_HD Rise rise_around(const int16_t* values, int place, int axis) {
  const int one = kStride[axis == 0 ? 1 : 0], other = kStride[axis == 2 ? 1 : 2], along = kStride[axis];
  Rise sum{0, 0};
  for (int i = -1; i <= 1; ++i)
    for (int j = -1; j <= 1; ++j) {
      const int16_t* middle = values + place + i * one + j * other;
      const int share = (i == 0 ? 2 : 1) * (j == 0 ? 2 : 1);
      for (int step = 1; step <= 2; ++step) {
        const int below = middle[-step * along], above = middle[step * along];
        if (below == kUnseen || above == kUnseen) continue;
        sum.rise += share * (above - below);
        sum.steps += share * step;
      }
    }
  return sum;
}

// The rise to the one neighbor that was seen, twice if there are two, none if there is none.
PC_HD float rise_to_seen(const int16_t* values, int place, int axis) {
  const int here = values[place], below = values[place - kStride[axis]], above = values[place + kStride[axis]];
  return static_cast<float>((above == kUnseen ? here : above) - (below == kUnseen ? here : below));
}

// How many marks come before a voxel's own.
PC_HD int marks_before(const uint32_t* marks, int voxel) {
  int count = 0;
  for (int word = 0; word < voxel / PC_WARP * 3; ++word) count += count_bits(marks[word]);
  const uint32_t lower = (uint32_t{1} << voxel % PC_WARP) - 1;
  for (int axis = 0; axis < 3; ++axis) count += count_bits(marks[voxel / PC_WARP * 3 + axis] & lower);
  return count;
}

// Write the crossings of every block from starts[block] on. `edge`, `colors` and `labels` may be null. A block of
// threads for each block.
PC_BLOCK_KERNEL(pc_write_crossings, PC_SORTED_PARAMETERS, PC_TABLE_PARAMETERS, PC_PLANES_PARAMETERS,
                const uint32_t* marks, const int64_t* starts, double voxel_size, int64_t* edge, float* points,
                float* normals, float* weight, int64_t* views, float* colors, int64_t* labels) {
  PC_SHARED(int16_t, values, kSide * kSide * kSide);
  PC_SHARED(int16_t, listed, 3 * kVoxels);
  PC_SHARED(int64_t, rows, 27);
  PC_SHARED(uint32_t, own_marks, kMarks);
  const int64_t block = block_index(), begin = starts[block];
  const int count = static_cast<int>(starts[block + 1] - begin);
  if (count == 0) return;  // all threads
  const SortedBlocks field{sorted_keys, sorted_rows, {keys, places, mask, shift}, {chunks, held}};
  for (int i = thread_in_block(); i < kMarks; i += block_size()) own_marks[i] = marks[block * kMarks + i];
  for (int i = thread_in_block(); i < 27; i += block_size())
    rows[i] = field.table.find_beside(field.keys[block], i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1);
  sync_block();
  for (int i = thread_in_block(); i < kSide * kSide * kSide; i += block_size()) {
    const int at[3] = {i % kSide - kBefore, i / kSide % kSide - kBefore, i / (kSide * kSide) - kBefore};
    const int around = (at[0] + kEdge) / kEdge + 3 * ((at[1] + kEdge) / kEdge) + 9 * ((at[2] + kEdge) / kEdge);
    const int voxel = (at[0] & 7) + kEdge * (at[1] & 7) + kSlab * (at[2] & 7);
    const int64_t row = rows[around];
    char* const from = row < 0 ? nullptr : field.planes.block(row);
    values[i] = row >= 0 && field.planes.weight(from)[voxel] > 0 ? field.planes.tsdf(from)[voxel]
                                                                 : static_cast<int16_t>(kUnseen);
  }
  for (int voxel = thread_in_block(); voxel < kVoxels; voxel += block_size()) {
    int bits = 0;
    for (int axis = 0; axis < 3; ++axis)
      bits |= static_cast<int>(own_marks[voxel / PC_WARP * 3 + axis] >> voxel % PC_WARP & 1) << axis;
    if (bits == 0) continue;
    int at = marks_before(own_marks, voxel);
    for (int axis = 0; axis < 3; ++axis)
      if (bits >> axis & 1) listed[at++] = static_cast<int16_t>(3 * voxel + axis);
  }
  sync_block();

  const BlockPlace corner = BlockPlace::of(field.keys[block]);
  const int64_t own = rows[13];
  for (int i = thread_in_block(); i < count; i += block_size()) {
    const int voxel = listed[i] / 3, axis = listed[i] % 3;
    const int inner[3] = {voxel % kEdge, voxel / kEdge % kEdge, voxel / kSlab};
    const int start = inner[0] + kBefore + kSide * (inner[1] + kBefore) + kSide * kSide * (inner[2] + kBefore);
    const int end = start + kStride[axis];
    const int64_t row = begin + i;
    const float before = values[start], after = values[end], fraction = math::crossing_fraction(before, after);
    const int64_t grid[3] = {corner.x * kEdge + inner[0], corner.y * kEdge + inner[1], corner.z * kEdge + inner[2]};
    float slope[3];
    for (int a = 0; a < 3; ++a) {
      const double along = static_cast<double>(grid[a]) + (a == axis ? static_cast<double>(fraction) : 0.0);
      points[3 * row + a] = static_cast<float>(along * voxel_size);
      const Rise first = rise_around(values, start, a), second = rise_around(values, end, a);
      slope[a] = math::slope_between(first.rise, second.rise, static_cast<float>(first.steps),
                                     static_cast<float>(second.steps), fraction);
      if (slope[a] != slope[a]) slope[a] = rise_to_seen(values, fraction <= 0.5f ? start : end, a);
    }
    const float length = sqrtf((slope[0] * slope[0] + slope[1] * slope[1]) + slope[2] * slope[2]);
    for (int a = 0; a < 3; ++a)
      normals[3 * row + a] = length > 0 ? slope[a] / length : a != axis ? 0.0f : after > before ? 1.0f : -1.0f;

    constexpr int next[3] = {14, 16, 22};  // around
    const bool is_beside = (voxel >> 3 * axis & 7) == kEdge - 1;
    const int voxel_step = axis == 0 ? 1 : axis == 1 ? kEdge : kSlab;
    const int end_voxel = voxel + (is_beside ? -(kEdge - 1) * voxel_step : voxel_step);
    char* const here = field.planes.block(own);
    char* const there = is_beside ? field.planes.block(rows[next[axis]]) : here;
    const int16_t weight0 = field.planes.weight(here)[voxel], weight1 = field.planes.weight(there)[end_voxel];
    weight[row] = weight0 < weight1 ? weight0 : weight1;
    const bool has_views = field.planes.has(VoxelPlanes::kViews);
    const int16_t views0 = has_views ? field.planes.views(here)[voxel] : weight0;
    const int16_t views1 = has_views ? field.planes.views(there)[end_voxel] : weight1;
    views[row] = views0 < views1 ? views0 : views1;
    if (edge != nullptr) edge[row] = 3 * (kVoxels * block + voxel) + axis;
    if (colors != nullptr) {
      const int32_t color0 = field.planes.color(here)[voxel], color1 = field.planes.color(there)[end_voxel];
      for (int c = 0; c < 3; ++c) colors[3 * row + c] = math::channel_between(color0, color1, c, fraction);
    }
    if (labels != nullptr)
      labels[row] = fraction <= 0.5f ? field.planes.label(here)[voxel] : field.planes.label(there)[end_voxel];
  }
}

}  // namespace pc::gpu
