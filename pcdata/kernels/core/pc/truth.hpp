// What a comparison of lanes gives, in the form that the processor computes it: one bit per lane with AVX-512, else all
// ones or zero in each.
#pragma once

#include "pc/lanes.hpp"

namespace pc {

#if defined(__AVX512DQ__)

struct Truth {
  __mmask16 bits;

  bool any() const { return bits != 0; }
  uint32_t mask() const { return bits; }
  Truth operator&(Truth other) const { return {static_cast<__mmask16>(bits & other.bits)}; }
  Truth operator|(Truth other) const { return {static_cast<__mmask16>(bits | other.bits)}; }
};

inline __m512 raw(const FloatLanes& lanes) { return reinterpret_cast<__m512>(lanes); }
inline __m512i raw(const IntLanes& lanes) { return reinterpret_cast<__m512i>(lanes); }
inline Truth less(const FloatLanes& a, const FloatLanes& b) { return {_mm512_cmp_ps_mask(raw(a), raw(b), _CMP_LT_OQ)}; }
inline Truth at_most(const FloatLanes& a, const FloatLanes& b) {
  return {_mm512_cmp_ps_mask(raw(a), raw(b), _CMP_LE_OQ)};
}
inline Truth less(const IntLanes& a, const IntLanes& b) { return {_mm512_cmplt_epi32_mask(raw(a), raw(b))}; }
inline Truth equal(const IntLanes& a, const IntLanes& b) { return {_mm512_cmpeq_epi32_mask(raw(a), raw(b))}; }
inline Truth unequal(const IntLanes& a, const IntLanes& b) { return {_mm512_cmpneq_epi32_mask(raw(a), raw(b))}; }
inline FloatLanes select(Truth truth, const FloatLanes& a, const FloatLanes& b) {
  return reinterpret_cast<FloatLanes>(_mm512_mask_blend_ps(truth.bits, raw(b), raw(a)));
}
inline IntLanes select(Truth truth, const IntLanes& a, const IntLanes& b) {
  return reinterpret_cast<IntLanes>(_mm512_mask_blend_epi32(truth.bits, raw(b), raw(a)));
}
inline Truth all_lanes() { return {0xffff}; }

#else

struct Truth {
  IntLanes lanes;

  bool any() const { return mask() != 0; }
  uint32_t mask() const { return bits_of_lanes(lanes); }
  Truth operator&(const Truth& other) const { return {lanes & other.lanes}; }
  Truth operator|(const Truth& other) const { return {lanes | other.lanes}; }
};

inline Truth less(const FloatLanes& a, const FloatLanes& b) { return {a < b}; }
inline Truth at_most(const FloatLanes& a, const FloatLanes& b) { return {a <= b}; }
inline Truth less(const IntLanes& a, const IntLanes& b) { return {a < b}; }
inline Truth equal(const IntLanes& a, const IntLanes& b) { return {a == b}; }
inline Truth unequal(const IntLanes& a, const IntLanes& b) { return {a != b}; }
template <class Lanes>
inline Lanes select(const Truth& truth, const Lanes& a, const Lanes& b) {
  return truth.lanes ? a : b;
}
inline Truth all_lanes() { return {IntLanes{} - 1}; }

#endif

// Write the chosen lanes one behind the other and return how many they are; up to a register is written.
inline int store_chosen(int32_t* to, const IntLanes& lanes, Truth chosen) {
#if defined(__AVX512DQ__)
  _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(chosen.bits, raw(lanes)));
#else
  int count = 0;
  for (uint32_t bits = chosen.mask(); bits != 0; bits &= bits - 1) to[count++] = lanes[__builtin_ctz(bits)];
#endif
  return __builtin_popcount(chosen.mask());
}

}  // namespace pc
