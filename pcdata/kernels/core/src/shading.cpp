// What the points in front have, at every pixel.
#include <algorithm>
#include <cmath>

#include "pc/threads.hpp"

PC_EXPORT int32_t pc_shade(const pc_context* context, const int64_t* item, int64_t pixels, int64_t items,
                           const int64_t* corners, const float* weights, int64_t num_corners, const float* values,
                           float* mixed, uint8_t* bytes) {
  using namespace pc;
  constexpr int64_t kPixelsPerPiece = int64_t{1} << 14;
  return guarded([&] {
    parallel_for(*context, pixels, kPixelsPerPiece, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i) {
        float sum[3] = {0, 0, 0};
        if (item[i] < items && corners == nullptr) {
          std::copy_n(values + 3 * item[i], 3, sum);
        } else if (item[i] < items) {
          for (int64_t k = 0; k < num_corners; ++k) {
            const float* value = values + 3 * corners[num_corners * item[i] + k];
            const float weight = weights[num_corners * i + k];
            for (int axis = 0; axis < 3; ++axis) {
              const float part = value[axis] * weight;
              sum[axis] = k == 0 ? part : sum[axis] + part;
            }
          }
        }
        for (int axis = 0; axis < 3; ++axis) {
          if (mixed != nullptr) mixed[3 * i + axis] = sum[axis];
          if (bytes != nullptr)
            bytes[3 * i + axis] = static_cast<uint8_t>(std::clamp(std::nearbyint(255.0F * sum[axis]), 0.0F, 255.0F));
        }
      }
    });
  });
}
