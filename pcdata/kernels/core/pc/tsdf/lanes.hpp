// The 16-bit numbers of voxels, as many as a register holds of the 32-bit ones they become.
#pragma once

#include "pc/simd.hpp"

namespace pc::tsdf {

using pc::select;
using pc::widened;

inline Int32Register widened(const Int16Lanes& lanes) {
#if defined(PC_AVX512)
  return reinterpret_cast<Int32Register>(_mm512_maskz_cvtepi16_epi32(kAll16, reinterpret_cast<__m256i>(lanes)));
#elif defined(__AVX2__)
  return reinterpret_cast<Int32Register>(_mm256_cvtepi16_epi32(reinterpret_cast<__m128i>(lanes)));
#else
  return __builtin_convertvector(lanes, Int32Register);
#endif
}
inline Int16Lanes narrowed(const Int32Register& lanes) { return __builtin_convertvector(lanes, Int16Lanes); }
inline Int16Lanes select(const RegisterMask& mask, const Int16Lanes& a, const Int16Lanes& b) {
#if defined(PC_AVX512) && defined(__AVX512BW__) && defined(__AVX512VL__)
  const auto from_a = reinterpret_cast<__m256i>(a), from_b = reinterpret_cast<__m256i>(b);
  return reinterpret_cast<Int16Lanes>(_mm256_mask_blend_epi16(mask.native, from_b, from_a));
#elif defined(PC_AVX512)
  return narrowed(pc::select(mask, widened(a), widened(b)));
#else
  return narrowed(mask.native) ? a : b;
#endif
}

// The sum of the products of the 16-bit halves of each lane.
inline Int32Register multiplied_in_pairs(const Int32Register& a, const Int32Register& b) {
#if defined(PC_AVX512)
  return reinterpret_cast<Int32Register>(_mm512_madd_epi16(native(a), native(b)));
#elif defined(__AVX2__)
  return reinterpret_cast<Int32Register>(_mm256_madd_epi16(reinterpret_cast<__m256i>(a), reinterpret_cast<__m256i>(b)));
#elif defined(__SSE2__)
  return reinterpret_cast<Int32Register>(_mm_madd_epi16(reinterpret_cast<__m128i>(a), reinterpret_cast<__m128i>(b)));
#else
  return (a << 16 >> 16) * (b << 16 >> 16) + (a >> 16) * (b >> 16);
#endif
}

// math::color_turn, in the upper half of each lane, of voxels that so many views have colored; `first` is the first
// one.
inline Int32Register color_turn(const Int32Register& views, int first) {
  Int32Register voxel;
  for (int i = 0; i < kLanes; ++i) voxel[i] = i << 16;
  voxel += first << 16;
  const Int32Register sum = multiplied_in_pairs((views & 0xffff) | voxel, Int32Register{} + (159 | 83 << 16));
  return (sum & 255) << 23;
}

// math::mixed_color; `less` is the share below zero, so that it fits 16 bits.
inline Int32Register mixed_color(const Int32Register& old, const Int32Register& pixel, const Int32Register& less,
                                 const Int32Register& turn) {
  typedef int16_t Halves __attribute__((vector_size(sizeof(Int32Register))));
  const Int32Register factors = turn | (less & 0xffff);
  const auto change = [&](int shift) {
    const Int32Register from = (old >> shift & 1023) | 1 << 16, to = pixel >> shift & 1023;
    const Halves apart = reinterpret_cast<Halves>(from) - reinterpret_cast<Halves>(to);
    return multiplied_in_pairs(reinterpret_cast<Int32Register>(apart), factors) >> 15;
  };
  return ((old + change(0)) + change(10) * (1 << 10)) + change(20) * (1 << 20);
}

}  // namespace pc::tsdf
