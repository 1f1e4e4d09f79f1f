// Points under affine maps, and inside a box.
#include <cmath>

#include "pc/math/affine.hpp"
#include "pc/threads.hpp"

namespace pc::rows {
namespace {

constexpr int64_t kPointsPerPiece = 16384;

// Call body(cloud, first, last) for the parts of [first, last) that lie in one cloud each.
template <class Body>
void each_cloud(const int64_t* ptr, int64_t num_clouds, int64_t first, int64_t last, const Body& body) {
  int64_t cloud = std::upper_bound(ptr, ptr + num_clouds + 1, first) - ptr - 1;
  for (int64_t row = first; row < last; ++cloud) {
    const int64_t end = std::min(last, ptr[cloud + 1]);
    if (end > row) body(cloud, row, end);
    row = std::max(row, end);
  }
}

}  // namespace
}  // namespace pc::rows

PC_EXPORT int32_t pc_transform_points(const pc_context* context, const float* points, const int64_t* ptr,
                                      int64_t num_clouds, const double* matrices, float* moved) {
  using namespace pc;
  using namespace pc::rows;
  return guarded([&] {
    parallel_for(*context, ptr[num_clouds], kPointsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      each_cloud(ptr, num_clouds, first, last, [&](int64_t cloud, int64_t begin, int64_t end) {
        const math::Affine move(matrices + 16 * cloud);
        for (int64_t i = begin; i < end; ++i) {
          const math::Point p = move({points[3 * i], points[3 * i + 1], points[3 * i + 2]});
          moved[3 * i] = p.x;
          moved[3 * i + 1] = p.y;
          moved[3 * i + 2] = p.z;
        }
      });
    });
  });
}

PC_EXPORT int32_t pc_transform_directions(const pc_context* context, const float* directions, const int64_t* ptr,
                                          int64_t num_clouds, const double* linear, float* turned) {
  using namespace pc;
  using namespace pc::rows;
  return guarded([&] {
    parallel_for(*context, ptr[num_clouds], kPointsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      each_cloud(ptr, num_clouds, first, last, [&](int64_t cloud, int64_t begin, int64_t end) {
        const double* m = linear + 9 * cloud;
        for (int64_t i = begin; i < end; ++i) {
          const double x = directions[3 * i], y = directions[3 * i + 1], z = directions[3 * i + 2];
          const double a = ((x * m[0] + y * m[1]) + z * m[2]) + 0.0;  // + 0: no negative zeros
          const double b = ((x * m[3] + y * m[4]) + z * m[5]) + 0.0;
          const double c = ((x * m[6] + y * m[7]) + z * m[8]) + 0.0;
          const double length = std::max(std::sqrt((a * a + b * b) + c * c), 1e-12);
          turned[3 * i] = static_cast<float>(a / length);
          turned[3 * i + 1] = static_cast<float>(b / length);
          turned[3 * i + 2] = static_cast<float>(c / length);
        }
      });
    });
  });
}

PC_EXPORT int32_t pc_inside_box(const pc_context* context, const float* points, int64_t rows, const float* lower,
                                const float* upper, uint8_t* inside, int64_t* finite) {
  using namespace pc;
  using namespace pc::rows;
  return guarded([&] {
    std::atomic<bool> all_finite{true};
    parallel_for(*context, rows, kPointsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      const math::CropBox box{{lower[0], lower[1], lower[2]}, {upper[0], upper[1], upper[2]}};
      int32_t wrong = 0;
      for (int64_t i = first; i < last; ++i) {
        const math::Point p{points[3 * i], points[3 * i + 1], points[3 * i + 2]};
        inside[i] = box.contains(p);
        wrong |= !math::is_finite(p);
      }
      if (wrong != 0) all_finite.store(false, std::memory_order_relaxed);
    });
    *finite = all_finite;
  });
}
