// Mean and covariance of the neighbors of every query, whose rows are known.
#include <algorithm>

#include "pc/threads.hpp"

namespace pc::neighborhoods {
namespace {

// Sums in the order of the neighbors: the mean of their offsets from the query, then of the squares about it.
struct Shape {
  double mean[3] = {0, 0, 0}, square[6] = {0, 0, 0, 0, 0, 0};

  template <class ForEach>
  Shape(int64_t count, ForEach&& for_each_offset) {
    const auto number = static_cast<double>(std::max<int64_t>(count, 1));
    for_each_offset([&](const double* offset) {
      for (int axis = 0; axis < 3; ++axis) mean[axis] += offset[axis];
    });
    for (double& value : mean) value /= number;
    for_each_offset([&](const double* offset) {
      const double x = offset[0] - mean[0], y = offset[1] - mean[1], z = offset[2] - mean[2];
      const double products[6] = {x * x, x * y, x * z, y * y, y * z, z * z};
      for (int i = 0; i < 6; ++i) square[i] += products[i];
    });
    for (double& value : square) value /= number;
  }
};

}  // namespace
}  // namespace pc::neighborhoods

PC_EXPORT int32_t pc_neighborhood_shapes(const pc_context* context, const float* points, int64_t num_points,
                                         const int64_t* index, int64_t num_queries, int64_t k, const float* centers,
                                         float* mean, double* covariance, int64_t* counts) {
  using namespace pc;
  using namespace pc::neighborhoods;
  return guarded([&] {
    const int64_t grain = std::max<int64_t>(1, (int64_t{1} << 14) / std::max<int64_t>(k, 1));
    parallel_for(*context, num_queries, grain, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t q = begin; q < end; ++q) {
        const int64_t* row = index + q * k;  // those that are missing come last
        const int64_t count =
            std::lower_bound(row, row + k, num_points, [&](int64_t one, int64_t missing) { return one != missing; }) -
            row;
        const double center[3] = {centers[3 * q], centers[3 * q + 1], centers[3 * q + 2]};
        const Shape shape(count, [&](auto&& take) {
          for (int64_t i = 0; i < count; ++i) {
            const float* point = points + 3 * row[i];
            const double offset[3] = {point[0] - center[0], point[1] - center[1], point[2] - center[2]};
            take(offset);
          }
        });
        for (int axis = 0; axis < 3; ++axis)
          mean[3 * q + axis] = count > 0 ? static_cast<float>(center[axis] + shape.mean[axis]) : 0.0F;
        constexpr int kPlace[9] = {0, 1, 2, 1, 3, 4, 2, 4, 5};
        for (int i = 0; i < 9; ++i) covariance[9 * q + i] = shape.square[kPlace[i]];
        counts[q] = count;
      }
    });
  });
}
