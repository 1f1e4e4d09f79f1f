// Depth that is smoothed within windows of pixels: means and medians of the readings on one surface.
#include <array>

#include "pc/images/padded_rows.hpp"

namespace pc::windows {
namespace {

// Whether two pixels have readings that differ by at most this part of the nearer one.
RegisterMask on_one_surface(const FloatRegister& own, const FloatRegister& other, const FloatRegister& max_jump) {
  const FloatRegister nearer = minimum(own, other);
  return less(FloatRegister{}, nearer) & less_equal(magnitude(own - other), max_jump * nearer);
}

// Write what body(pixels left of the window's rows) gives for as many pixels as a register holds, all along a row.
template <class Body>
void for_registers(const float* const* rows, int64_t window, int64_t width, float* to, Body&& body) {
  for (int64_t u = 0; u < width; u += kLanes) {
    const float* from[15];
    for (int64_t r = 0; r < window; ++r) from[r] = rows[r] + u;
    const FloatRegister found = body(from);
    std::memcpy(to + u, &found, static_cast<size_t>(std::min<int64_t>(kLanes, width - u)) * sizeof(float));
  }
}

// -- means --------------------------------------------------------------------------------------------------------

// 2 to the power of exponents up to 0, as pcdata/functional/depth/window_filters.py has it.
FloatRegister power_of_two(const FloatRegister& given) {
  constexpr float kPower[] = {0.6931468844413757f, 0.24022223055362701f, 0.055507998913526535f, 0.009672367945313454f,
                              0.0013253462966531515f};
  constexpr float kLeast = -100.0f;
  const FloatRegister exponent = maximum(given, FloatRegister{} + kLeast);
  const Int32Register whole = rounded(exponent);
  const FloatRegister rest = exponent - as_float(whole);
  FloatRegister value = FloatRegister{} + kPower[4];
  for (int i = 3; i >= 0; --i) value = value * rest + kPower[i];
  value = value * rest + 1.0f;
  return value * reinterpret_cast<FloatRegister>((whole + 127) << 23);
}

struct Weights {
  int64_t reach;
  const float* shares;  // (window, window)
  float scale, max_jump;
};

FloatRegister mean(const float* const* rows, const Weights& weights) {
  const int64_t window = 2 * weights.reach + 1;
  const FloatRegister zero{}, own = load<FloatRegister>(rows[weights.reach] + weights.reach);
  const FloatRegister max_jump = zero + weights.max_jump;
  FloatRegister total{}, weight{};
  for (int64_t r = 0; r < window; ++r)
    for (int64_t c = 0; c < window; ++c) {
      const FloatRegister other = load<FloatRegister>(rows[r] + c), offset = other - own,
                          scaled = offset * weights.scale;
      const FloatRegister whole = power_of_two(-(scaled * scaled)) * weights.shares[r * window + c];
      const FloatRegister share = select(on_one_surface(own, other, max_jump), whole, zero);
      total += share * offset;
      weight += share;
    }
  const RegisterMask there = less(zero, own);
  return select(there, own + total / select(there, weight, zero + 1.0f), zero);
}

// -- medians ------------------------------------------------------------------------------------------------------

// A network of exchanges after which the middle one of kCount values, an odd number, stands in the middle: that of
// Batcher's odd-even merge sort without the exchanges that do not lead there.
template <int kCount>
struct Network {
  int low[kCount * 12] = {}, high[kCount * 12] = {};
  int size = 0;

  constexpr Network() {
    int all_low[kCount * 12] = {}, all_high[kCount * 12] = {}, all = 0;
    for (int width = 1; width < kCount; width *= 2)
      for (int step = width; step >= 1; step /= 2)
        for (int start = step % width; start < kCount - step; start += 2 * step)
          for (int i = start; i < start + step && i < kCount - step; ++i)
            if (i / (2 * width) == (i + step) / (2 * width)) {
              all_low[all] = i;
              all_high[all++] = i + step;
            }
    bool asked[kCount] = {};
    bool kept[kCount * 12] = {};
    asked[kCount / 2] = true;
    for (int i = all - 1; i >= 0; --i) {
      kept[i] = asked[all_low[i]] || asked[all_high[i]];
      if (kept[i]) asked[all_low[i]] = asked[all_high[i]] = true;
    }
    for (int i = 0; i < all; ++i)
      if (kept[i]) {
        low[size] = all_low[i];
        high[size++] = all_high[i];
      }
  }
};

template <int kCount>
constexpr Network<kCount> kNetwork;

inline void exchange(FloatRegister& low, FloatRegister& high) {
  const FloatRegister smaller = minimum(low, high);
  high = maximum(low, high);
  low = smaller;
}

template <int kCount, size_t... kStep>
inline void bring_middle(FloatRegister (&values)[kCount], std::index_sequence<kStep...>) {
  (exchange(values[kNetwork<kCount>.low[kStep]], values[kNetwork<kCount>.high[kStep]]), ...);
}

// Pixels that do not count become 0 and infinity in turn: so the lower median of those that do is that of all.
template <int kReach, bool kAll>
FloatRegister median(const float* const* rows, float max_jump) {
  constexpr int kWindow = 2 * kReach + 1, kCount = kWindow * kWindow;
  constexpr int32_t kInfinity = 0x7F800000;
  const FloatRegister zero{}, own = load<FloatRegister>(rows[kReach] + kReach), jump = zero + max_jump;
  FloatRegister values[kCount], instead{};
  for (int r = 0; r < kWindow; ++r)
    for (int c = 0; c < kWindow; ++c) {
      const FloatRegister other = load<FloatRegister>(rows[r] + c);
      const RegisterMask counts = kAll ? less(zero, other) : on_one_surface(own, other, jump);
      const auto next = reinterpret_cast<FloatRegister>(reinterpret_cast<Int32Register>(instead) ^ kInfinity);
      values[r * kWindow + c] = select(counts, other, instead);
      instead = select(counts, instead, next);
    }
  bring_middle(values, std::make_index_sequence<static_cast<size_t>(kNetwork<kCount>.size)>());
  return select(less(zero, own), values[kCount / 2], zero);
}

template <int kReach>
void medians(const pc_context& context, const float* depth, const images::Shape& shape, float max_jump, float* found) {
  images::for_rows(context, depth, shape, kReach, [&](int64_t row, const float* const* rows) {
    float* to = found + row * shape.width;
    if (max_jump < 0)
      for_registers(rows, 2 * kReach + 1, shape.width, to,
                    [&](const float* const* from) { return median<kReach, true>(from, max_jump); });
    else
      for_registers(rows, 2 * kReach + 1, shape.width, to,
                    [&](const float* const* from) { return median<kReach, false>(from, max_jump); });
  });
}

}  // namespace
}  // namespace pc::windows

PC_EXPORT int32_t pc_bilateral_filter(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                      int64_t width, int64_t reach, const float* shares, double scale, double max_jump,
                                      float* smoothed) {
  using namespace pc;
  using namespace pc::windows;
  return guarded([&] {
    const Weights weights{reach, shares, static_cast<float>(scale), static_cast<float>(max_jump)};
    images::for_rows(*context, depth, {views, height, width}, reach, [&](int64_t row, const float* const* rows) {
      for_registers(rows, 2 * reach + 1, width, smoothed + row * width,
                    [&](const float* const* from) { return mean(from, weights); });
    });
  });
}

PC_EXPORT int32_t pc_median_filter(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                   int64_t width, int64_t reach, double max_jump, float* found) {
  using namespace pc;
  using namespace pc::windows;
  return guarded([&] {
    const images::Shape shape{views, height, width};
    const auto jump = static_cast<float>(max_jump);
    if (reach == 1)
      medians<1>(*context, depth, shape, jump, found);
    else if (reach == 2)
      medians<2>(*context, depth, shape, jump, found);
    else
      medians<3>(*context, depth, shape, jump, found);
  });
}
