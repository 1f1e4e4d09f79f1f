// Marking the points that are near a plane; for batches of clouds.
#include "pc/math/plane.hpp"
#include "pc/threads.hpp"

PC_EXPORT int32_t pc_near_planes(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                                 const float* planes, double distance, uint8_t* near) {
  using namespace pc;
  return guarded([&] {
    constexpr int64_t kMarkedRows = 8192;  // that one thread marks at a time
    const auto limit = static_cast<float>(distance);
    const auto* all = reinterpret_cast<const math::Plane*>(planes);
    for_each_piece(*context, cut_clouds(ptr, num_clouds, kMarkedRows), kMarkedRows,
                   [&](const CloudPiece& piece, int64_t) {
                     const math::Plane plane = all[piece.cloud];
                     for (int64_t i = piece.begin; i < piece.end; ++i) near[i] = plane.is_near(points + 3 * i, limit);
                   });
  });
}
