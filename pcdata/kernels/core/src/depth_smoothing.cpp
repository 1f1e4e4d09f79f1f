// Averages of depth images along rows and columns, and over time; holes filled from their rims.
#include "pc/images/padded_rows.hpp"
#include "pc/images/transpose.hpp"

namespace pc::smoothing {
namespace {

using images::Quad;

// -- values, or their reciprocals ---------------------------------------------------------------------------------

// What stands for values without a reading (0) is `none`; the others are kept, or divide `scale`.
template <bool kDivides>
struct Reading {
  float scale, none;

  float operator()(float value) const {
    const float known = value > 0 ? value : 1.0f, found = kDivides ? scale / known : known;
    return value > 0 ? found : none;
  }
  template <class Register>
  Register operator()(const Register& value) const {
    const Register one = Register{} + 1.0f, known = value > 0.0f ? value : one;
    const Register found = kDivides ? (Register{} + scale) / known : known, missing = Register{} + none;
    return value > 0.0f ? found : missing;
  }
};

// -- along rows and columns ---------------------------------------------------------------------------------------

// Far from every value, yet finite: no step to it is small, and what is multiplied by 0 leaves nothing.
constexpr float kHole = -1e30f;

constexpr int kRows = 32;      // rows of the image side by side
constexpr int kColumns = 128;  // columns side by side: all of them fit into the second cache
constexpr int kParts = kRows / kLanes;

struct Rule {
  float keep;   // of the average that arrives at a pixel; the rest is its own value
  float delta;  // the smallest step that is an edge
};

// Numbers `step` apart, kRows side by side, in place.
void smooth_band(float* at, int64_t count, int64_t step, const Rule& rule) {
  FloatRegister raw[kParts], mean[kParts];
  for (int part = 0; part < kParts; ++part) raw[part] = mean[part] = load<FloatRegister>(at + part * kLanes);
  const FloatRegister keep = FloatRegister{} + rule.keep, delta = FloatRegister{} + rule.delta;
  for (int64_t i = 1; i < count; ++i) {
    at += step;
    for (int part = 0; part < kParts; ++part) {
      const FloatRegister own = load<FloatRegister>(at + part * kLanes), change = own - raw[part];
      const FloatRegister weight = select(less(magnitude(change), delta), keep, FloatRegister{});
      mean[part] = own + weight * (mean[part] - own);
      raw[part] = own;
      store(at + part * kLanes, mean[part]);
    }
  }
}

// Up to kRows rows become the columns of a band, (width, kRows); rows that are not there are the last one again.
template <class Convert>
void fetch_band(const float* image, int64_t rows, int64_t width, float* band, const Convert& convert) {
  const float* from[kRows];
  for (int64_t r = 0; r < kRows; ++r) from[r] = image + std::min(r, rows - 1) * width;
  int64_t column = 0;
  for (; column + 4 <= width; column += 4)
    for (int r = 0; r < kRows; r += 4) {
      Quad some[4];
      for (int i = 0; i < 4; ++i) some[i] = convert(load<Quad>(from[r + i] + column));
      images::transpose(some);
      for (int i = 0; i < 4; ++i) store(band + (column + i) * kRows + r, some[i]);
    }
  for (; column < width; ++column)
    for (int r = 0; r < kRows; ++r) band[column * kRows + r] = convert(from[r][column]);
}

void return_band(const float* band, int64_t rows, int64_t width, float* image) {
  for (int64_t r = 0; r < rows; r += 4) {
    const int64_t some_rows = std::min<int64_t>(4, rows - r);
    int64_t column = 0;
    for (; column + 4 <= width; column += 4) {
      Quad some[4];
      for (int i = 0; i < 4; ++i) some[i] = load<Quad>(band + (column + i) * kRows + r);
      images::transpose(some);
      for (int64_t i = 0; i < some_rows; ++i) store(image + (r + i) * width + column, some[i]);
    }
    for (; column < width; ++column)
      for (int64_t i = 0; i < some_rows; ++i) image[(r + i) * width + column] = band[column * kRows + r + i];
  }
}

// `count` columns of numbers `step` apart, in place; what is written is converted, what is averaged is not.
template <class Convert>
void smooth_columns(float* at, int64_t height, int64_t step, int count, const Rule& rule, const Convert& convert) {
  alignas(64) float raw[kColumns], mean[kColumns];
  for (int i = 0; i < count; ++i) {
    raw[i] = mean[i] = at[i];
    at[i] = convert(at[i]);
  }
  for (int64_t row = 1; row < height; ++row) {
    at += step;
    for (int i = 0; i < count; ++i) {
      const float own = at[i], weight = std::fabs(own - raw[i]) < rule.delta ? rule.keep : 0.0f;
      mean[i] = own + weight * (mean[i] - own);
      raw[i] = own;
      at[i] = convert(mean[i]);
    }
  }
}

template <bool kDivides>
void smooth(const pc_context& context, const float* values, const float* scales, const images::Shape& size,
            const Rule& rule, int64_t iterations, float* smoothed) {
  const auto [views, height, width] = size;
  const int64_t bands = (height + kRows - 1) / kRows, stripes = (width + kColumns - 1) / kColumns;
  const auto plain = [](const auto& value) { return value; };
  for (int64_t iteration = 0; iteration < iterations; ++iteration) {
    const bool first = iteration == 0, last = iteration + 1 == iterations;
    parallel_for(context, views * bands, 1, [&](int64_t begin, int64_t end, int64_t) {
      std::vector<float> room(static_cast<size_t>(width * kRows + kRows));
      float* band = room.data();
      for (int64_t i = begin; i < end; ++i) {
        const int64_t view = i / bands, row = i % bands * kRows, rows = std::min<int64_t>(kRows, height - row);
        const int64_t place = (view * height + row) * width;
        if (first)
          fetch_band(values + place, rows, width, band, Reading<kDivides>{kDivides ? scales[view] : 0.0f, kHole});
        else
          fetch_band(smoothed + place, rows, width, band, plain);
        smooth_band(band, width, kRows, rule);
        smooth_band(band + (width - 1) * kRows, width, -kRows, rule);
        return_band(band, rows, width, smoothed + place);
      }
    });
    parallel_for(context, views * stripes, 1, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i) {
        const int64_t view = i / stripes, column = i % stripes * kColumns;
        const int count = static_cast<int>(std::min<int64_t>(kColumns, width - column));
        float* top = smoothed + view * height * width + column;
        float* bottom = top + (height - 1) * width;
        smooth_columns(top, height, width, count, rule, plain);
        if (last)
          smooth_columns(bottom, height, -width, count, rule, Reading<kDivides>{kDivides ? scales[view] : 0.0f, 0.0f});
        else
          smooth_columns(bottom, height, -width, count, rule, plain);
      }
    });
  }
}

// -- over time ----------------------------------------------------------------------------------------------------

constexpr int64_t kPiece = int64_t{1} << 14;  // pixels that a thread takes at once
constexpr int64_t kSome = 256;                // and works on at once

// So many readings of the last frames make a pixel repeat the last one.
struct Persistence {
  int32_t needed, frames;

  // One bit less for every reading but one that is needed; 0 = they are not there.
  Int32Register bits(const Int32Register& history) const {
    if (needed == 0) return Int32Register{} + 1;
    Int32Register left = history & ((1 << frames) - 1);
    for (int32_t i = 1; i < needed; ++i) left &= left - 1;
    return left;
  }
};

struct Memory {
  const float* last;
  const uint8_t* history;
  float* new_last;
  uint8_t* new_history;

  Memory from(int64_t at) const { return {last + at, history + at, new_last + at, new_history + at}; }
};

// kSome pixels.
template <bool kDivides>
void filter_some(const float* values, const Memory& memory, const Rule& rule, const Persistence& persistence,
                 const Reading<kDivides>& reading, float* filtered) {
  alignas(64) int32_t history[kSome];
  const uint8_t* old_history = memory.history;
  uint8_t* new_history = memory.new_history;  // not read again after each byte, which may lie anywhere
  for (int i = 0; i < kSome; ++i) history[i] = old_history[i];
  const FloatRegister zero{}, keep = zero + rule.keep, delta = zero + rule.delta;
  for (int i = 0; i < kSome; i += kLanes) {
    const FloatRegister now = reading(load<FloatRegister>(values + i)), before = load<FloatRegister>(memory.last + i);
    const Int32Register past = load<Int32Register>(history + i), one = Int32Register{} + 1, shifted = past << 1;
    const RegisterMask valid = less(zero, now), known = less(zero, before);
    const RegisterMask steady = valid & known & less(magnitude(now - before), delta);
    const FloatRegister mixed = select(steady, now + keep * (before - now), now);
    const RegisterMask bridged = known & unequal(persistence.bits(past), Int32Register{});
    store(filtered + i, reading(select(valid, mixed, select(bridged, before, zero))));
    store(memory.new_last + i, select(valid, mixed, before));
    store(history + i, select(valid, select(steady, shifted, Int32Register{}) | one, shifted));
  }
  for (int i = 0; i < kSome; ++i) new_history[i] = static_cast<uint8_t>(history[i]);
}

// Up to kSome pixels; what lies beyond them is not looked at.
template <bool kDivides>
void filter_over_time(const float* values, const Memory& memory, int count, const Rule& rule,
                      const Persistence& persistence, const Reading<kDivides>& reading, float* filtered) {
  if (count == kSome) return filter_some(values, memory, rule, persistence, reading, filtered);
  float own[kSome] = {}, last[kSome] = {}, new_own[kSome], new_last[kSome];
  uint8_t history[kSome] = {}, new_history[kSome];
  std::copy_n(values, count, own);
  std::copy_n(memory.last, count, last);
  std::copy_n(memory.history, count, history);
  filter_some(own, {last, history, new_last, new_history}, rule, persistence, reading, new_own);
  std::copy_n(new_own, count, filtered);
  std::copy_n(new_last, count, memory.new_last);
  std::copy_n(new_history, count, memory.new_history);
}

template <bool kDivides>
void filter_over_time(const pc_context& context, const float* values, const float* scales, int64_t views,
                      int64_t pixels, const Rule& rule, const Persistence& persistence, const Memory& memory,
                      float* filtered) {
  const int64_t pieces = (pixels + kPiece - 1) / kPiece;
  parallel_for(context, views * pieces, 1, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t i = begin; i < end; ++i) {
      const int64_t view = i / pieces, first = i % pieces * kPiece, past = std::min(first + kPiece, pixels);
      const Reading<kDivides> reading{kDivides ? scales[view] : 0.0f, 0.0f};
      for (int64_t at = view * pixels + first; at < view * pixels + past; at += kSome) {
        const auto count = static_cast<int>(std::min(kSome, view * pixels + past - at));
        filter_over_time(values + at, memory.from(at), count, rule, persistence, reading, filtered + at);
      }
    }
  });
}

}  // namespace
}  // namespace pc::smoothing

PC_EXPORT int32_t pc_reciprocals(const pc_context* context, const float* values, const float* scales, int64_t views,
                                 int64_t pixels, float* reciprocals) {
  using namespace pc;
  using namespace pc::smoothing;
  return guarded([&] {
    const int64_t pieces = (pixels + kPiece - 1) / kPiece;
    parallel_for(*context, views * pieces, 1, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i) {
        const int64_t view = i / pieces, first = i % pieces * kPiece, last = std::min(first + kPiece, pixels);
        const Reading<true> reading{scales[view], 0.0f};
        for (int64_t at = view * pixels + first; at < view * pixels + last; ++at) reciprocals[at] = reading(values[at]);
      }
    });
  });
}

PC_EXPORT int32_t pc_spatial_filter(const pc_context* context, const float* values, const float* scales, int64_t views,
                                    int64_t height, int64_t width, double keep, double delta, int64_t iterations,
                                    float* smoothed) {
  using namespace pc;
  using namespace pc::smoothing;
  return guarded([&] {
    if (height == 0 || width == 0) return;
    const Rule rule{static_cast<float>(keep), static_cast<float>(delta)};
    const images::Shape size{views, height, width};
    if (scales == nullptr)
      smooth<false>(*context, values, scales, size, rule, iterations, smoothed);
    else
      smooth<true>(*context, values, scales, size, rule, iterations, smoothed);
  });
}

PC_EXPORT int32_t pc_temporal_filter(const pc_context* context, const float* values, const float* scales, int64_t views,
                                     int64_t pixels, double keep, double delta, int64_t needed, int64_t frames,
                                     const float* last, const uint8_t* history, float* filtered, float* new_last,
                                     uint8_t* new_history) {
  using namespace pc;
  using namespace pc::smoothing;
  return guarded([&] {
    const Rule rule{static_cast<float>(keep), static_cast<float>(delta)};
    const Persistence persistence{static_cast<int32_t>(needed), static_cast<int32_t>(frames)};
    const Memory memory{last, history, new_last, new_history};
    if (scales == nullptr)
      filter_over_time<false>(*context, values, scales, views, pixels, rule, persistence, memory, filtered);
    else
      filter_over_time<true>(*context, values, scales, views, pixels, rule, persistence, memory, filtered);
  });
}
