// Triangles between the zero crossings of a truncated signed distance field, in the order of
// pcdata/functional/tsdf/marching.py.
//
// Words hold a property of 32 voxels each: which are inside, which were seen, and on which edges there is a vertex.
#pragma once

#include "pc/gpu/tsdf_surface.hpp"

namespace pc::gpu {

constexpr int kSigns = 2 * kGroups;  // words of a block: per group inside, seen

// A thread for each voxel of the sorted blocks.
PC_BLOCK_KERNEL(pc_find_signs, const int64_t* sorted_rows, int64_t count, PC_PLANES_PARAMETERS, int64_t bound,
                uint32_t* signs) {
  const int64_t block = thread_index() / kVoxels;
  if (block >= count) return;  // all of a warp
  const int voxel = static_cast<int>(thread_index() % kVoxels);
  const VoxelPlanes planes{chunks, held};
  char* const from = planes.block(sorted_rows[block]);
  const uint32_t inside = ballot(planes.tsdf(from)[voxel] < 0), seen = ballot(planes.weight(from)[voxel] > bound);
  if (lane() != 0) return;
  signs[block * kSigns + voxel / PC_WARP * 2] = inside;
  signs[block * kSigns + voxel / PC_WARP * 2 + 1] = seen;
}

// A thread for each group of 32 voxels: bits of the edges with a vertex, and the row of the first of these.
PC_KERNEL(pc_index_vertices, const int64_t* edge, int64_t num_edges, int64_t count, uint32_t* vertices,
          int64_t* first_vertex) {
  const int64_t group = thread_index();
  if (group >= count * kGroups) return;
  int64_t low = 0, high = num_edges;
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (edge[middle] < group * 3 * PC_WARP)
      low = middle + 1;
    else
      high = middle;
  }
  first_vertex[group] = low;
  uint32_t words[3] = {0, 0, 0};
  for (; low < num_edges && edge[low] < (group + 1) * 3 * PC_WARP; ++low) {
    const int inner = static_cast<int>(edge[low] - group * 3 * PC_WARP);
    words[inner % 3] |= uint32_t{1} << inner / 3;
  }
  for (int axis = 0; axis < 3; ++axis) vertices[3 * group + axis] = words[axis];
}

// What cubes look up. Edges of the cube: 3 * the corner at which one starts + its axis.
#define PC_MESH_PARAMETERS                                                                             \
  const int64_t *sorted_keys, const int64_t *place_of_row, PC_TABLE_PARAMETERS, const uint32_t *signs, \
      const uint32_t *vertices, const int64_t *first_vertex, const int64_t *cases, const int64_t *case_corners

struct Mesh {
  const uint32_t *signs, *vertices;
  const int64_t* first_vertex;
  const int64_t *cases, *case_corners;  // (257,) the first triangle of each case; (K, 3) edges of the cube
  const int64_t* around;                // (8) places of the block and those behind it along x, y, z; -1 = none

  struct Corner {
    int64_t block;
    int voxel;
  };
  PC_HD Corner corner_of(int cube, int corner) const {
    const int x = cube % kEdge + (corner & 1), y = cube / kEdge % kEdge + (corner >> 1 & 1),
              z = cube / kSlab + (corner >> 2);
    return {around[x / kEdge + 2 * (y / kEdge) + 4 * (z / kEdge)],
            x % kEdge + kEdge * (y % kEdge) + kSlab * (z % kEdge)};
  }
  PC_HD bool sign(const Corner& at, int which) const {
    return signs[at.block * kSigns + at.voxel / PC_WARP * 2 + which] >> at.voxel % PC_WARP & 1;
  }
  // Which corners of a cube are inside; 0 where not all were seen.
  PC_HD int inside(int cube) const {
    int bits = 0;
    for (int c = 0; c < 8; ++c) {
      const Corner at = corner_of(cube, c);
      if (at.block < 0 || !sign(at, 1)) return 0;
      bits |= static_cast<int>(sign(at, 0)) << c;
    }
    return bits;
  }
  // The row of the vertex on an edge of a cube; -1 if there is none.
  PC_HD int64_t vertex(int cube, int64_t cube_edge) const {
    const Corner at = corner_of(cube, static_cast<int>(cube_edge / 3));
    const int axis = static_cast<int>(cube_edge % 3);
    const int64_t group = at.block * kGroups + at.voxel / PC_WARP;
    const uint32_t own = uint32_t{1} << at.voxel % PC_WARP;
    if ((vertices[3 * group + axis] & own) == 0) return -1;
    int64_t row = first_vertex[group];
    for (int a = 0; a < 3; ++a) row += count_bits(vertices[3 * group + a] & (a < axis ? (own - 1) | own : own - 1));
    return row;
  }
  // Call body(a, b, c) for every triangle of a cube that has its three vertices.
  template <class Body>
  PC_HD void each_triangle(int cube, Body&& body) const {
    const int bits = inside(cube);
    for (int64_t t = cases[bits]; t < cases[bits + 1]; ++t) {
      const int64_t a = vertex(cube, case_corners[3 * t]), b = vertex(cube, case_corners[3 * t + 1]),
                    c = vertex(cube, case_corners[3 * t + 2]);
      if (a >= 0 && b >= 0 && c >= 0) body(a, b, c);
    }
  }
};

PC_HD void look_behind(int64_t block, const int64_t* sorted_keys, const int64_t* place_of_row, const RowTable& table,
                       int64_t* around) {
  const int c = thread_in_block();
  if (c < 8) {
    const int64_t row = table.find_beside(sorted_keys[block], c & 1, c >> 1 & 1, c >> 2);
    around[c] = row < 0 ? -1 : place_of_row[row];
  }
  sync_block();
}

// A block of kVoxels threads for each block: a cube each.
PC_BLOCK_KERNEL(pc_count_triangles, PC_MESH_PARAMETERS, int64_t* counts) {
  PC_SHARED(int64_t, around, 8);
  PC_SHARED(int32_t, total, 1);
  if (thread_in_block() == 0) total[0] = 0;
  look_behind(block_index(), sorted_keys, place_of_row, {keys, places, mask, shift}, around);
  const Mesh mesh{signs, vertices, first_vertex, cases, case_corners, around};
  int32_t own = 0;
  mesh.each_triangle(thread_in_block(), [&](int64_t, int64_t, int64_t) { ++own; });
  if (own > 0) atomic_add(total, own);
  sync_block();
  if (thread_in_block() == 0) counts[block_index()] = total[0];
}

// Write the triangles of each block from starts[block] on, and mark the vertices that they use.
PC_BLOCK_KERNEL(pc_write_triangles, PC_MESH_PARAMETERS, const int64_t* starts, int64_t* triangles, uint8_t* used) {
  PC_SHARED(int64_t, around, 8);
  PC_SHARED(int32_t, of_warps, kVoxels / PC_WARP);
  const int64_t begin = starts[block_index()];
  if (starts[block_index() + 1] == begin) return;  // all threads
  look_behind(block_index(), sorted_keys, place_of_row, {keys, places, mask, shift}, around);
  const Mesh mesh{signs, vertices, first_vertex, cases, case_corners, around};
  const int cube = thread_in_block();
  int32_t own = 0;
  mesh.each_triangle(cube, [&](int64_t, int64_t, int64_t) { ++own; });
  int32_t until = own;  // triangles of the warp's cubes up to this one
  for (int step = 1; step < PC_WARP; step *= 2) {
    const int32_t other = from_lane(until, lane() >= step ? lane() - step : lane());
    if (lane() >= step) until += other;
  }
  if (lane() == PC_WARP - 1) of_warps[cube / PC_WARP] = until;
  sync_block();
  int64_t at = begin + until - own;
  for (int warp = 0; warp < cube / PC_WARP; ++warp) at += of_warps[warp];
  mesh.each_triangle(cube, [&](int64_t a, int64_t b, int64_t c) {
    const int64_t corners[3] = {a, b, c};
    for (int i = 0; i < 3; ++i) {
      triangles[3 * at + i] = corners[i];
      used[corners[i]] = 1;
    }
    ++at;
  });
}

}  // namespace pc::gpu
