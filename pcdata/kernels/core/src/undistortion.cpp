// Images sampled where a map says: colors, and depths that are never blended across an edge.
#include <algorithm>
#include <cmath>

#include "pc/threads.hpp"

namespace pc::undistortion {
namespace {

constexpr int64_t kPixelsPerPiece = 8192;

// A place in an image, with the operations of the reference.
struct Place {
  double u, v;
  int64_t height, width;

  bool is_valid() const {
    return (u >= -0.5) & (u < static_cast<double>(width) - 0.5) & (v >= -0.5) & (v < static_cast<double>(height) - 0.5);
  }
  // Of a valid place.
  int64_t nearest() const {
    const auto column = static_cast<int64_t>(std::floor(u + 0.5)), row = static_cast<int64_t>(std::floor(v + 0.5));
    return std::clamp<int64_t>(row, 0, height - 1) * width + std::clamp<int64_t>(column, 0, width - 1);
  }
};

// The four pixels around a valid place, and their weights.
struct Corners {
  int64_t pixel[4];
  float weight[4];

  explicit Corners(const Place& place) {
    const double u = std::clamp(place.u, 0.0, static_cast<double>(place.width - 1));
    const double v = std::clamp(place.v, 0.0, static_cast<double>(place.height - 1));
    const auto left = std::min(static_cast<int64_t>(u), std::max<int64_t>(place.width - 2, 0));
    const auto top = std::min(static_cast<int64_t>(v), std::max<int64_t>(place.height - 2, 0));
    const double across = u - static_cast<double>(left), down = v - static_cast<double>(top);
    const int64_t right = std::min(left + 1, place.width - 1), bottom = std::min(top + 1, place.height - 1);
    pixel[0] = top * place.width + left;
    pixel[1] = top * place.width + right;
    pixel[2] = bottom * place.width + left;
    pixel[3] = bottom * place.width + right;
    weight[0] = static_cast<float>((1 - down) * (1 - across));
    weight[1] = static_cast<float>((1 - down) * across);
    weight[2] = static_cast<float>(down * (1 - across));
    weight[3] = static_cast<float>(down * across);
  }
};

// Whole numbers are rounded, halves to even.
void put(float value, uint8_t& to) { to = static_cast<uint8_t>(std::clamp(std::nearbyint(value), 0.0F, 255.0F)); }
void put(float value, float& to) { to = value; }

template <class Value>
void sample(const Value* image, const Place& place, int64_t channels, bool nearest, Value* sampled) {
  if (!place.is_valid()) {
    std::fill_n(sampled, channels, Value{0});
    return;
  }
  if (nearest) {
    std::copy_n(image + place.nearest() * channels, channels, sampled);
    return;
  }
  const Corners corners(place);
  for (int64_t channel = 0; channel < channels; ++channel) {
    float mixed = 0;
    for (int i = 0; i < 4; ++i)
      mixed = mixed + static_cast<float>(image[corners.pixel[i] * channels + channel]) * corners.weight[i];
    put(mixed, sampled[channel]);
  }
}

float sample_depth(const float* depth, const Place& place, float nearest, bool surface, float max_jump) {
  if (!surface || !(nearest > 0)) return nearest;
  const Corners corners(place);
  float low = depth[corners.pixel[0]], high = low;
  for (int i = 1; i < 4; ++i) {
    low = std::min(low, depth[corners.pixel[i]]);
    high = std::max(high, depth[corners.pixel[i]]);
  }
  if (!(low > 0 && high - low <= max_jump * low)) return nearest;
  float inverse = corners.weight[0] / depth[corners.pixel[0]];
  for (int i = 1; i < 4; ++i) inverse = inverse + corners.weight[i] / depth[corners.pixel[i]];
  return 1.0F / inverse;
}

}  // namespace
}  // namespace pc::undistortion

PC_EXPORT int32_t pc_sample_image(const pc_context* context, const uint8_t* whole, const float* real, int64_t views,
                                  int64_t height, int64_t width, int64_t channels, const double* places,
                                  int64_t out_pixels, int64_t nearest, uint8_t* sampled_whole, float* sampled_real,
                                  uint8_t* valid) {
  using namespace pc;
  using namespace pc::undistortion;
  return guarded([&] {
    parallel_for(*context, views * out_pixels, kPixelsPerPiece, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i) {
        const Place place{places[2 * i], places[2 * i + 1], height, width};
        const int64_t view = i / out_pixels * height * width * channels;
        if (whole != nullptr)
          sample(whole + view, place, channels, nearest != 0, sampled_whole + i * channels);
        else
          sample(real + view, place, channels, nearest != 0, sampled_real + i * channels);
        valid[i] = place.is_valid();
      }
    });
  });
}

PC_EXPORT int32_t pc_sample_depth(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                  int64_t width, const double* places, int64_t out_pixels, int64_t surface,
                                  double max_jump, float* sampled, int64_t* pixel_index) {
  using namespace pc;
  using namespace pc::undistortion;
  return guarded([&] {
    parallel_for(*context, views * out_pixels, kPixelsPerPiece, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i) {
        const Place place{places[2 * i], places[2 * i + 1], height, width};
        const float* own = depth + i / out_pixels * height * width;
        pixel_index[i] = place.is_valid() ? place.nearest() : -1;
        const float nearest = pixel_index[i] < 0 ? 0.0F : own[pixel_index[i]];
        sampled[i] = sample_depth(own, place, nearest, surface != 0, static_cast<float>(max_jump));
      }
    });
  });
}
