// The 16-bit numbers of voxels, as many as a register holds of the 32-bit ones they become.
#pragma once

#include "pc/simd.hpp"

namespace pc::tsdf {

using pc::select;
using pc::widened;

typedef uint16_t Uint16Lanes __attribute__((vector_size(2 * kLanes)));

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

}  // namespace pc::tsdf
