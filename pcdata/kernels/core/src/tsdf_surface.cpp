// Zero crossings of a truncated signed distance field: the same numbers as pcdata/functional/tsdf/surface.py, the
// normals up to the last bit of a square root.
#include <memory>

#include "pc/math/fusion.hpp"
#include "pc/threads.hpp"
#include "pc/tsdf/field.hpp"

namespace pc::tsdf {
namespace {

constexpr int64_t kBlocksPerPiece = 64;       // blocks
constexpr int kMostEdges = 3 * kVoxels + 16;  // edges of a block, and a line so that columns do not share cache sets
constexpr int kVoxelStep[3] = {1, kEdge, kSlab}, kShift[3] = {0, 3, 6};  // of the coordinates in a voxel's number

// -- counting -----------------------------------------------------------------------------------------------------

// Start loading a block.
template <class T>
void fetch(const T* block) {
  for (size_t at = 0; at < kVoxels * sizeof(T); at += 64) __builtin_prefetch(reinterpret_cast<const char*>(block) + at);
}
void fetch(const Distances& block) {
  fetch(block.tsdf);
  fetch(block.weight);
}

void count_all(const pc_context& context, const Field& field, int16_t bound, int64_t* counts, Marks* marks,
               int64_t* dropped) {
  std::atomic<int64_t> all_dropped{0};
  parallel_for(context, field.blocks.count, kBlocksPerPiece, [&](int64_t begin, int64_t end, int64_t) {
    Column own(field.blocks, begin, 0, 0), right(field.blocks, begin, 1, 0), below(field.blocks, begin, 0, 1);
    EdgeEnds ends;
    int64_t lost = 0;
    for (int64_t i = begin; i < end; ++i) {
      int64_t along[3], across[3], down[3];
      own.look(field.blocks.keys[i], along);
      right.look(field.blocks.keys[i], across);
      below.look(field.blocks.keys[i], down);
      const Distances near[4] = {Distances::of(field, i), Distances::of(field, across[1]),
                                 Distances::of(field, down[1]), Distances::of(field, along[2])};
      marks[i] = ends.marks(near[0], near[1], near[2], near[3], bound);
      counts[i] = marks[i].count();
      if (bound > 0) lost += ends.marks(near[0], near[1], near[2], near[3], 0).count() - counts[i];
    }
    all_dropped.fetch_add(lost, std::memory_order_relaxed);
  });
  *dropped = all_dropped.load();
}

// -- points -------------------------------------------------------------------------------------------------------

struct Points {
  int64_t* edge;  // or null
  float *points, *normals, *weight;
  int64_t* views;
  float* colors;    // or null
  int64_t* labels;  // or null
};

// One plane of a block and of the next ones along x, y and z, to read at both ends of an edge.
template <class T>
struct PlaneAround {
  const T* of[4];

  PlaneAround(const VoxelPlane<T>& plane, const SortedBlocks& blocks, const int64_t places[27]) {
    constexpr int around[4] = {13, 14, 16, 22};
    for (int i = 0; i < 4; ++i) of[i] = places[around[i]] < 0 ? nullptr : plane.block(blocks.rows[places[around[i]]]);
  }
};

// The crossings of one block, column by column, so that compilers vectorize the arithmetic.
struct Crossings {
  int count;
  int32_t voxel[kMostEdges], axis[kMostEdges], start[kMostEdges];
  int32_t end_block[kMostEdges], end_voxel[kMostEdges];  // of the second end: 0 is the block itself, 1 + axis the next
  float before[kMostEdges], after[kMostEdges], fraction[kMostEdges], place[kMostEdges];
  int32_t corner[kMostEdges];  // coordinate of the first end, in voxels, along the axis
  int32_t first[3][kMostEdges], second[3][kMostEdges];
  float gradient[3][kMostEdges], length[kMostEdges];
  int32_t packed[2][kMostEdges];
  float channel[3][kMostEdges];

  void list(const Marks& marks) {
    count = 0;
    for (int z = 0; z < kEdge; ++z)
      for (uint64_t left = marks.any(z); left != 0; left &= left - 1) {
        const int inner = __builtin_ctzll(left);
        for (int a = 0; a < 3; ++a) {
          voxel[count] = kSlab * z + inner;
          axis[count] = a;
          count += static_cast<int>(marks.along[z][a] >> inner & 1);
        }
      }
  }

  void read(const BlockMargin& near, const BlockPlace& block) {
    const auto x = static_cast<int32_t>(block.x * kEdge), y = static_cast<int32_t>(block.y * kEdge),
               z = static_cast<int32_t>(block.z * kEdge);
    const int32_t corners[3] = {x, y, z};
    for (int i = 0; i < count; ++i) {
      const int v = voxel[i], a = axis[i];
      start[i] = place_of(v & 7, v >> 3 & 7, v >> 6);
      const int end = start[i] + kStride[a];
      before[i] = static_cast<float>(near.value(start[i]));
      after[i] = static_cast<float>(near.value(end));
      const int inner = v >> kShift[a] & 7;
      corner[i] = corners[a] + inner;
      end_block[i] = inner == kEdge - 1 ? 1 + a : 0;
      end_voxel[i] = v + (inner == kEdge - 1 ? -(kEdge - 1) : 1) * kVoxelStep[a];
      for (int b = 0; b < 3; ++b) {
        first[b][i] = near.slope(b, start[i]);
        second[b][i] = near.slope(b, end);
      }
    }
  }

  void locate(double voxel_size) {
    for (int i = 0; i < count; ++i) {
      fraction[i] = math::crossing_fraction(before[i], after[i]);
      const double along = static_cast<double>(corner[i]) + static_cast<double>(fraction[i]);
      place[i] = static_cast<float>(along * voxel_size);
    }
  }

  // Interpolated between both ends, each as much as it has seen.
  void find_gradients(const BlockMargin& near) {
    for (int a = 0; a < 3; ++a) {
      int32_t unseen = 0;
      for (int i = 0; i < count; ++i) {
        const int32_t rise0 = rise_in(first[a][i]), rise1 = rise_in(second[a][i]);
        const auto steps0 = static_cast<float>((first[a][i] - rise0) >> 24);
        const auto steps1 = static_cast<float>((second[a][i] - rise1) >> 24);
        gradient[a][i] = math::slope_between(rise0, rise1, steps0, steps1, fraction[i]);
        unseen |= static_cast<int32_t>(gradient[a][i] != gradient[a][i]);
      }
      if (unseen != 0)
        for (int i = 0; i < count; ++i)
          if (gradient[a][i] != gradient[a][i])
            gradient[a][i] = near.rise_to_seen(fraction[i] <= 0.5f ? start[i] : start[i] + kStride[axis[i]], a);
    }
    for (int i = 0; i < count; ++i) {
      const float x = gradient[0][i], y = gradient[1][i], z = gradient[2][i];
      length[i] = std::sqrt((x * x + y * y) + z * z);
    }
    for (int a = 0; a < 3; ++a)
      for (int i = 0; i < count; ++i) gradient[a][i] /= length[i];
  }
  static int32_t rise_in(int32_t both) { return static_cast<int32_t>(static_cast<uint32_t>(both) << 8) >> 8; }

  template <class T>
  T first_of(const PlaneAround<T>& plane, int i) const {
    return plane.of[0][voxel[i]];
  }
  template <class T>
  T second_of(const PlaneAround<T>& plane, int i) const {
    return plane.of[end_block[i]][end_voxel[i]];
  }
  template <class T>
  T least_of(const PlaneAround<T>& plane, int i) const {
    return std::min(first_of(plane, i), second_of(plane, i));
  }

  void mix_colors(const PlaneAround<int32_t>& color) {
    for (int i = 0; i < count; ++i) {
      packed[0][i] = first_of(color, i);
      packed[1][i] = second_of(color, i);
    }
    for (int c = 0; c < 3; ++c)
      for (int i = 0; i < count; ++i) {
        channel[c][i] = math::channel_between(packed[0][i], packed[1][i], c, fraction[i]);
      }
  }

  void write(const BlockPlace& block, double voxel_size, float* points, float* normals) const {
    float grid[3][kEdge];
    const int64_t corners[3] = {block.x * kEdge, block.y * kEdge, block.z * kEdge};
    for (int a = 0; a < 3; ++a)
      for (int j = 0; j < kEdge; ++j) grid[a][j] = static_cast<float>(static_cast<double>(corners[a] + j) * voxel_size);
    for (int i = 0; i < count; ++i) {
      float* point = points + 3 * i;
      for (int a = 0; a < 3; ++a) point[a] = grid[a][voxel[i] >> kShift[a] & 7];
      point[axis[i]] = place[i];
      float* normal = normals + 3 * i;
      for (int a = 0; a < 3; ++a) normal[a] = gradient[a][i];
      if (!(length[i] > 0)) {
        for (int a = 0; a < 3; ++a) normal[a] = 0;
        normal[axis[i]] = after[i] > before[i] ? 1.0f : -1.0f;
      }
    }
  }
};

void write_block(const Field& field, int64_t number, const int64_t places[27], const BlockMargin& near,
                 double voxel_size, Crossings& found, const Points& out, int64_t row) {
  const BlockPlace block = BlockPlace::of(field.blocks.keys[number]);
  found.read(near, block);
  found.locate(voxel_size);
  found.find_gradients(near);
  found.write(block, voxel_size, out.points + 3 * row, out.normals + 3 * row);
  const PlaneAround<int16_t> weight(field.planes.weight, field.blocks, places);
  const PlaneAround<int16_t> views(field.planes.views ? field.planes.views : field.planes.weight, field.blocks, places);
  for (int i = 0; i < found.count; ++i) {
    out.weight[row + i] = static_cast<float>(found.least_of(weight, i));
    out.views[row + i] = found.least_of(views, i);
  }
  if (out.edge != nullptr)
    for (int i = 0; i < found.count; ++i) out.edge[row + i] = 3 * (kVoxels * number + found.voxel[i]) + found.axis[i];
  if (out.colors != nullptr) {
    found.mix_colors({field.planes.color, field.blocks, places});
    for (int i = 0; i < found.count; ++i)
      for (int c = 0; c < 3; ++c) out.colors[3 * (row + i) + c] = found.channel[c][i];
  }
  if (out.labels != nullptr) {
    const PlaneAround<int32_t> label(field.planes.label, field.blocks, places);
    for (int i = 0; i < found.count; ++i)
      out.labels[row + i] = found.fraction[i] <= 0.5f ? found.first_of(label, i) : found.second_of(label, i);
  }
}

// What a thread works in.
struct Workspace {
  BlockMargin near;
  Crossings found;
};

void write_all(const pc_context& context, const Field& field, const Marks* marks, const int64_t* starts,
               double voxel_size, const Points& out) {
  std::vector<std::unique_ptr<Workspace>> workspaces(static_cast<size_t>(std::max(context.threads, 1)));
  parallel_for(context, field.blocks.count, kBlocksPerPiece, [&](int64_t begin, int64_t end, int64_t thread) {
    auto& own = workspaces[static_cast<size_t>(thread)];
    if (!own) own.reset(new Workspace);
    Surroundings around(field.blocks, begin);
    const auto next_from = [&](int64_t i) {
      while (i < end && starts[i] == starts[i + 1]) ++i;
      return i;
    };
    int64_t ahead[27];
    int64_t next = next_from(begin);
    if (next < end) around.look(field.blocks.keys[next], ahead);
    while (next < end) {
      const int64_t i = next;
      int64_t places[27];
      Distances distances[27];
      std::memcpy(places, ahead, sizeof places);
      for (int b = 0; b < 27; ++b) distances[b] = Distances::of(field, places[b]);
      next = next_from(i + 1);
      if (next < end) {
        around.look(field.blocks.keys[next], ahead);
        // The rest of what it reads lies around the blocks before it.
        fetch(Distances::of(field, ahead[13]));
        fetch(Distances::of(field, ahead[14]));
        if (out.colors != nullptr) fetch(field.planes.color.block(field.blocks.rows[ahead[13]]));
      }
      const LineRange lines = LineRange::of(marks[i]);
      own->near.fill(distances, lines.wider(2, 2));
      own->near.find_slopes(lines);
      own->found.list(marks[i]);
      write_block(field, i, places, own->near, voxel_size, own->found, out, starts[i]);
    }
  });
}

}  // namespace
}  // namespace pc::tsdf

PC_EXPORT int32_t pc_tsdf_count_crossings(const pc_context* context, const int64_t* keys, const int64_t* rows,
                                          int64_t count, const int64_t* const* planes, int64_t bound, int64_t* counts,
                                          int64_t* marks, int64_t* dropped) {
  using namespace pc;
  using namespace pc::tsdf;
  return guarded([&] {
    const Field field{{keys, rows, count}, VoxelPlanes(planes)};
    count_all(*context, field, static_cast<int16_t>(bound), counts, reinterpret_cast<Marks*>(marks), dropped);
  });
}

PC_EXPORT int32_t pc_tsdf_write_crossings(const pc_context* context, const int64_t* keys, const int64_t* rows,
                                          int64_t count, const int64_t* const* planes, const int64_t* marks,
                                          const int64_t* starts, double voxel_size, int64_t* edge, float* points,
                                          float* normals, float* weight, int64_t* views, float* colors,
                                          int64_t* labels) {
  using namespace pc;
  using namespace pc::tsdf;
  return guarded([&] {
    const Field field{{keys, rows, count}, VoxelPlanes(planes)};
    write_all(*context, field, reinterpret_cast<const Marks*>(marks), starts, voxel_size,
              {edge, points, normals, weight, views, colors, labels});
  });
}
