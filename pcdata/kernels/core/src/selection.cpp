// Masks of points: inside a box of their cloud, inside a polygon, or repeats of an earlier one.
#include <cstring>

#include "pc/math/polygon.hpp"
#include "pc/threads.hpp"
#include "pc/voxels/table.hpp"

namespace pc::selection {
namespace {

constexpr int64_t kRowsPerPiece = int64_t{1} << 14;
constexpr int64_t kBlock = 256;          // points that go along all edges together
constexpr int64_t kShareFrom = 1 << 16;  // rows of a cloud whose repeats are looked for by several threads

void mark_in_polygon(const float* points, int64_t count, const math::Edge* edges, int64_t num_edges, uint8_t* inside) {
  double x[kBlock], y[kBlock];
  int32_t crossed[kBlock] = {};
  for (int64_t i = 0; i < count; ++i) {
    x[i] = points[2 * i];
    y[i] = points[2 * i + 1];
  }
  for (int64_t e = 0; e < num_edges; ++e) {
    const math::Edge edge = edges[e];
    for (int64_t i = 0; i < count; ++i) crossed[i] ^= edge.is_right_of(x[i], y[i]);
  }
  for (int64_t i = 0; i < count; ++i) inside[i] = static_cast<uint8_t>(crossed[i]);
}

// A point as three numbers that are equal where the coordinates are; -0 becomes 0.
math::WideVoxel place_of(const float* point) {
  int32_t bits[3];
  for (int axis = 0; axis < 3; ++axis) {
    const float value = point[axis] + 0.0F;
    std::memcpy(bits + axis, &value, sizeof value);
  }
  return {bits[0], bits[1], bits[2]};
}

// Mark the repeats in rows [0, count) of one cloud, of the points whose hash leaves `share` of `shares`: every point
// and its repeats are in one share, so shares need nothing of one another.
void mark_repeats(ScratchFrame& scratch, const float* points, int64_t count, uint64_t share, uint64_t shares,
                  uint8_t* repeats) {
  voxels::VoxelTable<math::WideVoxel> table(scratch, count);
  table.start(scratch.take<math::WideVoxel>(count));
  for (int64_t i = 0; i < count; ++i) {
    const math::WideVoxel place = place_of(points + 3 * i);
    if (shares > 1 && (place.hash() >> 7) % shares != share) continue;
    const int64_t known = table.count();
    table.number(place);
    repeats[i] = table.count() == known;
  }
}

}  // namespace
}  // namespace pc::selection

PC_EXPORT int32_t pc_box_mask(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                              const float* lower, const float* upper, uint8_t* inside) {
  using namespace pc;
  using namespace pc::selection;
  return guarded([&] {
    const auto pieces = cut_clouds(ptr, num_clouds, kRowsPerPiece);
    for_each_piece(*context, pieces, kRowsPerPiece, [&](const CloudPiece& piece, int64_t) {
      const float *low = lower + 3 * piece.cloud, *high = upper + 3 * piece.cloud;
      const float l0 = low[0], l1 = low[1], l2 = low[2], h0 = high[0], h1 = high[1], h2 = high[2];
      for (int64_t i = piece.begin; i < piece.end; ++i) {
        const float x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
        inside[i] = (l0 <= x) & (x <= h0) & (l1 <= y) & (y <= h1) & (l2 <= z) & (z <= h2);
      }
    });
  });
}

PC_EXPORT int32_t pc_polygon_mask(const pc_context* context, const float* points, int64_t rows, const double* corners,
                                  int64_t num_corners, uint8_t* inside) {
  using namespace pc;
  using namespace pc::selection;
  return guarded([&] {
    std::vector<math::Edge> edges;
    for (int64_t i = 0; i < num_corners; ++i)
      edges.push_back(math::edge_between(corners + 2 * i, corners + 2 * ((i + 1) % num_corners)));
    const int64_t blocks = std::max<int64_t>(1, kRowsPerPiece / std::max<int64_t>(1, num_corners / 8) / kBlock);
    parallel_for(*context, rows, blocks * kBlock, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t at = begin; at < end; at += kBlock)
        mark_in_polygon(points + 2 * at, std::min(kBlock, end - at), edges.data(), num_corners, inside + at);
    });
  });
}

PC_EXPORT int32_t pc_duplicate_mask(const pc_context* context, const float* points, const int64_t* ptr,
                                    int64_t num_clouds, uint8_t* repeats) {
  using namespace pc;
  using namespace pc::selection;
  return guarded([&] {
    struct Share {
      int64_t cloud;
      uint64_t number, of;
    };
    std::vector<Share> work;
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud) {
      const int64_t count = ptr[cloud + 1] - ptr[cloud];
      const auto shares = static_cast<uint64_t>(count < kShareFrom ? 1 : context->threads);
      for (uint64_t number = 0; number < shares && count > 0; ++number) work.push_back({cloud, number, shares});
    }
    parallel_for(*context, static_cast<int64_t>(work.size()), 1, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i) {
        const Share& share = work[static_cast<size_t>(i)];
        const int64_t first = ptr[share.cloud];
        ScratchFrame scratch;
        mark_repeats(scratch, points + 3 * first, ptr[share.cloud + 1] - first, share.number, share.of,
                     repeats + first);
      }
    });
  });
}
