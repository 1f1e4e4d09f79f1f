// Images sampled where a map says: colors, and depths that are never blended across an edge.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "pc/simd.hpp"
#include "pc/threads.hpp"

namespace pc::undistortion {
namespace {

constexpr int64_t kPixelsPerPiece = 8192;
constexpr int kBlock = 256;  // places whose pixels and weights are computed side by side, then looked up one by one

struct Size {
  int64_t height, width;
};

// A block of places in one image, with the operations of the reference. What a place has that is not valid is that of
// place (0, 0).
class Block {
 public:
  // Which places (u, v) are valid: within the image.
  void start(const double* places, int count, const Size& size) {
    count_ = count;
    size_ = size;
    const double most_u = static_cast<double>(size.width) - 0.5, most_v = static_cast<double>(size.height) - 0.5;
    for (int i = 0; i < count; ++i) {
      const double u = places[2 * i], v = places[2 * i + 1];
      const bool within = (u >= -0.5) & (u < most_u) & (v >= -0.5) & (v < most_v);
      valid[i] = within;
      u_[i] = within ? u : 0.0;
      v_[i] = within ? v : 0.0;
    }
  }

  // The nearest pixel of every place.
  void find_nearest() {
    const int count = count_;
    const auto last_column = static_cast<double>(size_.width - 1), last_row = static_cast<double>(size_.height - 1);
    for (int i = 0; i < count; ++i) {
      // Neither is negative: cutting off rounds down.
      const double u = u_[i] + 0.5, v = v_[i] + 0.5;
      column[i] = static_cast<int32_t>(u < last_column ? u : last_column);
      row[i] = static_cast<int32_t>(v < last_row ? v : last_row);
    }
  }

  // The upper left of the four pixels around every place, and their weights.
  void find_corners() {
    const int count = count_;
    const auto last_column = static_cast<double>(size_.width - 1), last_row = static_cast<double>(size_.height - 1);
    const auto last_left = static_cast<int32_t>(std::max<int64_t>(size_.width - 2, 0));
    const auto last_top = static_cast<int32_t>(std::max<int64_t>(size_.height - 2, 0));
    for (int i = 0; i < count; ++i) {
      const double u_floor = u_[i] < 0 ? 0.0 : u_[i], v_floor = v_[i] < 0 ? 0.0 : v_[i];
      const double u = u_floor < last_column ? u_floor : last_column, v = v_floor < last_row ? v_floor : last_row;
      const auto column_cut = static_cast<int32_t>(u), row_cut = static_cast<int32_t>(v);
      const int32_t left = column_cut < last_left ? column_cut : last_left;
      const int32_t top = row_cut < last_top ? row_cut : last_top;
      const double across = u - static_cast<double>(left), down = v - static_cast<double>(top);
      column[i] = left;
      row[i] = top;
      weight[0][i] = static_cast<float>((1 - down) * (1 - across));
      weight[1][i] = static_cast<float>((1 - down) * across);
      weight[2][i] = static_cast<float>(down * (1 - across));
      weight[3][i] = static_cast<float>(down * across);
    }
  }

  int64_t pixel(int i) const { return int64_t{row[i]} * size_.width + column[i]; }

  alignas(64) int32_t valid[kBlock], column[kBlock], row[kBlock];
  alignas(64) float weight[4][kBlock];

 private:
  alignas(64) double u_[kBlock], v_[kBlock];
  int count_ = 0;
  Size size_{};
};

// From the upper left of four pixels around a place to all of them; in an image of one column or row they coincide.
struct Around {
  int64_t step[4];

  explicit Around(const Size& size) {
    const int64_t right = size.width > 1, below = size.height > 1 ? size.width : 0;
    step[0] = 0, step[1] = right, step[2] = below, step[3] = below + right;
  }
};

// Call body(block, count, first of its places, view) for the places [begin, end) of all views.
template <class Body>
void for_blocks(const double* places, int64_t begin, int64_t end, int64_t out_pixels, const Size& size, Body&& body) {
  Block block;
  while (begin < end) {
    const int64_t view = begin / out_pixels;
    const auto count = static_cast<int>(std::min<int64_t>({kBlock, end - begin, (view + 1) * out_pixels - begin}));
    block.start(places + 2 * begin, count, size);
    body(block, count, begin, view);
    begin += count;
  }
}

// Whole numbers are rounded, halves to even.
void put(float value, uint8_t& to) { to = static_cast<uint8_t>(std::clamp(std::nearbyint(value), 0.0F, 255.0F)); }
void put(float value, float& to) { to = value; }

// One pixel from the four at `corner`; the sum begins with 0, as that of the reference.
template <class Value>
void mix(const Value* corner, const Around& around, const Block& block, int i, int64_t channels, Value* sampled) {
  for (int64_t channel = 0; channel < channels; ++channel) {
    float mixed = 0;
    for (int k = 0; k < 4; ++k)
      mixed = mixed + static_cast<float>(corner[around.step[k] * channels + channel]) * block.weight[k][i];
    put(mixed, sampled[channel]);
  }
}

typedef uint8_t FourBytes __attribute__((vector_size(4)));
typedef int32_t FourInts __attribute__((vector_size(16)));
typedef float FourFloats __attribute__((vector_size(16)));

// Compilers find neither instruction.
FourInts widened(const uint8_t* from) {
#if defined(__SSE2__)
  int32_t word;
  std::memcpy(&word, from, sizeof word);
  const __m128i zero = _mm_setzero_si128();
  return reinterpret_cast<FourInts>(_mm_unpacklo_epi16(_mm_unpacklo_epi8(_mm_cvtsi32_si128(word), zero), zero));
#elif defined(PC_NEON)
  uint32_t word;
  std::memcpy(&word, from, sizeof word);
  return reinterpret_cast<FourInts>(vmovl_u16(vget_low_u16(vmovl_u8(vreinterpret_u8_u32(vdup_n_u32(word))))));
#else
  FourBytes bytes;
  std::memcpy(&bytes, from, sizeof bytes);
  return __builtin_convertvector(bytes, FourInts);
#endif
}
// Of numbers from 0 to 255.
void store_narrowed(uint8_t* to, const FourInts& numbers) {
#if defined(__SSE2__)
  const __m128i words = _mm_packs_epi32(reinterpret_cast<__m128i>(numbers), reinterpret_cast<__m128i>(numbers));
  const int32_t word = _mm_cvtsi128_si32(_mm_packus_epi16(words, words));
  std::memcpy(to, &word, sizeof word);
#elif defined(PC_NEON)
  const uint16x4_t words = vmovn_u32(reinterpret_cast<uint32x4_t>(numbers));
  const uint32_t word = vget_lane_u32(vreinterpret_u32_u8(vmovn_u16(vcombine_u16(words, words))), 0);
  std::memcpy(to, &word, sizeof word);
#else
  const FourBytes bytes = __builtin_convertvector(numbers, FourBytes);
  std::memcpy(to, &bytes, sizeof bytes);
#endif
}

// The same for three or four bytes at once; reads and writes four.
template <int64_t kChannels>
void mix_bytes(const uint8_t* corner, const Around& around, const Block& block, int i, uint8_t* sampled) {
  FourFloats mixed = {};
  for (int k = 0; k < 4; ++k)
    mixed =
        mixed + __builtin_convertvector(widened(corner + around.step[k] * kChannels), FourFloats) * block.weight[k][i];
  // No weight is negative and their sum is 1 to a few roundings: 0 to 255.0001. In the sum with 2^23 the last bits are
  // the number, rounded to nearest, halves to even.
  constexpr float kShift = 8388608.0F;
  constexpr int32_t kShiftBits = 0x4B000000;
  const FourFloats shifted = mixed + kShift;
  store_narrowed(sampled, reinterpret_cast<FourInts>(shifted) - kShiftBits);
}

template <class Value>
struct Sampling {
  const Value* image;  // (views, height, width, channels)
  int64_t views, channels;
  Size size;
  Around around;
  Value* sampled;  // (views, out_pixels, channels)

  int64_t per_view() const { return size.height * size.width * channels; }

  void nearest(Block& block, int count, int64_t first, int64_t view) const {
    block.find_nearest();
    const Value* own = image + view * per_view();
    const int64_t some = channels;  // not read again after each byte, which may lie anywhere
    Value* to = sampled + first * some;
    for (int i = 0; i < count; ++i, to += some) {
      const Value* from = own + block.pixel(i) * some;
      const bool is_valid = block.valid[i] != 0;
      for (int64_t channel = 0; channel < some; ++channel) to[channel] = is_valid ? from[channel] : Value{0};
    }
  }

  void bilinear(Block& block, int count, int64_t first, int64_t view) const {
    block.find_corners();
    if constexpr (sizeof(Value) == 1) {
      if (channels == 3) return by_bytes<3>(block, count, first, view);
      if (channels == 4) return by_bytes<4>(block, count, first, view);
    }
    const Value* own = image + view * per_view();
    for (int i = 0; i < count; ++i) one(own, block, i, sampled + (first + i) * channels);
  }

 private:
  void one(const Value* own, const Block& block, int i, Value* to) const {
    if (block.valid[i])
      mix(own + block.pixel(i) * channels, around, block, i, channels, to);
    else
      std::fill_n(to, channels, Value{0});
  }

  // Four bytes are read and written where three are wanted: not at the end of the images, and in the order of places.
  template <int64_t kChannels>
  void by_bytes(const Block& block, int count, int64_t first, int64_t view) const {
    const Value* own = image + view * per_view();
    const int64_t last = (views - view) * per_view() - 4 - around.step[3] * kChannels;
    const Around own_around = around;  // not read again after each byte, which may lie anywhere
    Value* to = sampled + first * kChannels;
    for (int i = 0; i < count; ++i, to += kChannels) {
      const int64_t at = block.pixel(i) * kChannels;
      if (block.valid[i] && at <= last && (kChannels == 4 || i + 1 < count))
        mix_bytes<kChannels>(own + at, own_around, block, i, to);
      else
        one(own, block, i, to);
    }
  }
};

template <class Value>
void sample_image(const pc_context& context, const Sampling<Value>& sampling, const double* places, int64_t out_pixels,
                  bool nearest, uint8_t* valid) {
  parallel_for(context, sampling.views * out_pixels, kPixelsPerPiece, [&](int64_t begin, int64_t end, int64_t) {
    for_blocks(places, begin, end, out_pixels, sampling.size,
               [&](Block& block, int count, int64_t first, int64_t view) {
                 uint8_t* const to = valid + first;  // not read again after each byte, which may lie anywhere
                 for (int i = 0; i < count; ++i) to[i] = static_cast<uint8_t>(block.valid[i]);
                 if (nearest)
                   sampling.nearest(block, count, first, view);
                 else
                   sampling.bilinear(block, count, first, view);
               });
  });
}

// The depth of the surface through the four pixels at `corner`, or the nearest reading where they are not of one.
float on_surface(const float* corner, const Around& around, const Block& block, int i, float nearest, float max_jump) {
  float low = corner[around.step[0]], high = low;
  for (int k = 1; k < 4; ++k) {
    low = std::min(low, corner[around.step[k]]);
    high = std::max(high, corner[around.step[k]]);
  }
  if (!(low > 0 && high - low <= max_jump * low)) return nearest;
  float inverse = block.weight[0][i] / corner[around.step[0]];
  for (int k = 1; k < 4; ++k) inverse = inverse + block.weight[k][i] / corner[around.step[k]];
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
    const Size size{height, width};
    const Around around(size);
    if (whole != nullptr)
      sample_image<uint8_t>(*context, {whole, views, channels, size, around, sampled_whole}, places, out_pixels,
                            nearest != 0, valid);
    else
      sample_image<float>(*context, {real, views, channels, size, around, sampled_real}, places, out_pixels,
                          nearest != 0, valid);
  });
}

PC_EXPORT int32_t pc_sample_depth(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                  int64_t width, const double* places, int64_t out_pixels, int64_t surface,
                                  double max_jump, float* sampled, int64_t* pixel_index) {
  using namespace pc;
  using namespace pc::undistortion;
  return guarded([&] {
    const Size size{height, width};
    const Around around(size);
    parallel_for(*context, views * out_pixels, kPixelsPerPiece, [&](int64_t begin, int64_t end, int64_t) {
      for_blocks(places, begin, end, out_pixels, size, [&](Block& block, int count, int64_t first, int64_t view) {
        const float* own = depth + view * height * width;
        block.find_nearest();
        for (int i = 0; i < count; ++i) {
          const int64_t pixel = block.pixel(i);
          pixel_index[first + i] = block.valid[i] ? pixel : -1;
          sampled[first + i] = block.valid[i] ? own[pixel] : 0.0F;
        }
        if (surface == 0) return;
        block.find_corners();
        for (int i = 0; i < count; ++i)
          if (sampled[first + i] > 0)
            sampled[first + i] =
                on_surface(own + block.pixel(i), around, block, i, sampled[first + i], static_cast<float>(max_jump));
      });
    });
  });
}
