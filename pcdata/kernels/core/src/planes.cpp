// Scoring plane hypotheses, and marking what is near one.
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
