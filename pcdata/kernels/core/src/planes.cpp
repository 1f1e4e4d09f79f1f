// Scoring plane hypotheses, and the sums for refining the winner.
#include <cmath>

#include "pc/plane_sums.hpp"

namespace pc {
namespace {

constexpr int kTogether = 4;  // planes per load of a point: four times four coefficients fit 32 registers
// Points that one thread takes at a time: 1000 hypotheses on them take about 2 ms.
constexpr int64_t kPiece = 8 * PointBlock::kSize;

// Which of the points [begin, end) are near a plane.
void mark_near(const float* points, int64_t begin, int64_t end, const Plane& plane, float distance, uint8_t* near) {
  for (int64_t i = begin; i < end; ++i) {
    const float* p = points + 3 * i;
    near[i] = std::fabs(((plane.x * p[0] + plane.y * p[1]) + plane.z * p[2]) + plane.d) < distance;
  }
}

// Counts of all planes on points [begin, end).
void count_piece(const float* points, int64_t begin, int64_t end, const Plane* planes, int64_t num_planes,
                 float distance, int64_t* counts) {
  PointBlock block;
  for (int64_t i = begin; i < end; i += PointBlock::kSize) {
    block.read(points, i, std::min<int64_t>(end, i + PointBlock::kSize));
    int64_t h = 0;
    for (; h + kTogether <= num_planes; h += kTogether) count_near<kTogether>(block, planes + h, distance, counts + h);
    for (; h < num_planes; ++h) count_near<1>(block, planes + h, distance, counts + h);
  }
}

// A float where chosen, else 0, as eight doubles.
Double8 chosen(const float* points, const uint8_t* mask, int64_t first, int axis, double centre) {
  Double8 values;
  for (int lane = 0; lane < 8; ++lane) {
    const double offset = static_cast<double>(points[3 * (first + lane) + axis]) - centre;
    values[lane] = mask[first + lane] != 0 ? offset : 0.0;
  }
  return values;
}

struct Sums {
  PlaneMoments moments;
  float largest;  // absolute coordinate
  int64_t count;
};

// Sums over the chosen points of [begin, end) about a centre.
Sums sums_of(const float* points, const uint8_t* mask, int64_t begin, int64_t end, const double* centre) {
  Sums sums{};
  int64_t i = begin;
  for (; i + 8 <= end; i += 8)
    sums.moments.add(chosen(points, mask, i, 0, centre[0]), chosen(points, mask, i, 1, centre[1]),
                     chosen(points, mask, i, 2, centre[2]));
  float last_points[24] = {};
  uint8_t last_mask[8] = {};
  std::copy(points + 3 * i, points + 3 * end, last_points);
  std::copy(mask + i, mask + end, last_mask);
  sums.moments.add(chosen(last_points, last_mask, 0, 0, centre[0]), chosen(last_points, last_mask, 0, 1, centre[1]),
                   chosen(last_points, last_mask, 0, 2, centre[2]));
  for (int64_t row = begin; row < end; ++row) {
    sums.count += mask[row];
    for (int axis = 0; axis < 3; ++axis) {
      const float size = mask[row] != 0 ? std::fabs(points[3 * row + axis]) : 0.0f;
      sums.largest = size > sums.largest ? size : sums.largest;
    }
  }
  return sums;
}

}  // namespace
}  // namespace pc

// points (N, 3), planes (H, 4) -> counts (H,): the points with |((nx*x + ny*y) + nz*z) + d| < distance.
PC_EXPORT int32_t pc_count_near_planes(const pc_context* context, const float* points, int64_t count,
                                       const float* planes, int64_t num_planes, double distance, int64_t* counts) {
  return pc::guarded([&] {
    pc::ScratchFrame scratch;
    const auto* all = reinterpret_cast<const pc::Plane*>(planes);
    const int64_t threads = std::max<int64_t>(1, context->threads);
    int64_t* own = scratch.take<int64_t>(threads * num_planes);  // (thread, plane)
    std::fill_n(own, threads * num_planes, 0);
    pc::parallel_for(*context, count, pc::kPiece, [&](int64_t begin, int64_t end, int64_t thread) {
      pc::count_piece(points, begin, end, all, num_planes, static_cast<float>(distance), own + thread * num_planes);
    });
    std::copy_n(own, num_planes, counts);
    for (int64_t i = num_planes; i < threads * num_planes; ++i) counts[i % num_planes] += own[i];
  });
}

// points (N, 3), plane (4,) -> near (N,), 0 or 1.
PC_EXPORT int32_t pc_near_plane(const pc_context* context, const float* points, int64_t count, const float* plane,
                                double distance, uint8_t* near) {
  return pc::guarded([&] {
    const pc::Plane one{plane[0], plane[1], plane[2], plane[3]};
    pc::parallel_for(*context, count, pc::kPiece, [&](int64_t begin, int64_t end, int64_t) {
      pc::mark_near(points, begin, end, one, static_cast<float>(distance), near);
    });
  });
}

// points (N, 3), mask (N,) of 0 and 1, centre (3,) -> sums (11,) over the chosen points, with p their offsets from the
// centre: count, largest absolute coordinate, x, y, z, xx, xy, xz, yy, yz, zz. The same bits for any number of threads:
// pieces are added in order.
PC_EXPORT int32_t pc_plane_sums(const pc_context* context, const float* points, const uint8_t* mask, int64_t count,
                                const double* centre, double* sums) {
  return pc::guarded([&] {
    pc::ScratchFrame scratch;
    const int64_t pieces = (count + pc::kPiece - 1) / pc::kPiece;
    pc::Sums* found = scratch.take<pc::Sums>(pieces);
    pc::parallel_for(*context, count, pc::kPiece, [&](int64_t begin, int64_t end, int64_t) {
      found[begin / pc::kPiece] = pc::sums_of(points, mask, begin, end, centre);
    });
    std::fill_n(sums, 11, 0.0);
    for (int64_t piece = 0; piece < pieces; ++piece) {
      const pc::PlaneMoments& m = found[piece].moments;
      const pc::Double8 lanes[9] = {m.x, m.y, m.z, m.xx, m.xy, m.xz, m.yy, m.yz, m.zz};
      sums[0] += static_cast<double>(found[piece].count);
      sums[1] = std::max(sums[1], static_cast<double>(found[piece].largest));
      for (int k = 0; k < 9; ++k)
        for (int lane = 0; lane < 8; ++lane) sums[2 + k] += lanes[k][lane];
    }
  });
}
