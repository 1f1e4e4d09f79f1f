// Sixteen numbers handled as one, with the compilers' vector extension: one AVX-512 register, two of AVX2, four of SSE.
// For short loops with reductions, which compilers do not vectorise reliably.
#pragma once

#include "pc/common.hpp"
#include "pc/geometry.hpp"

#if defined(__AVX512DQ__) || defined(__AVX2__)
#include <immintrin.h>
#endif

// Lanes are passed between inline functions only, so no calling convention is at stake.
#pragma GCC diagnostic ignored "-Wpsabi"

namespace pc {

constexpr int kLanes = 16;

typedef float Float16 __attribute__((vector_size(64)));
typedef int32_t Int16 __attribute__((vector_size(64)));
typedef uint32_t Uint16 __attribute__((vector_size(64)));
typedef int64_t Long8 __attribute__((vector_size(64)));
typedef double Double8 __attribute__((vector_size(64)));

template <class Lanes, class T>
inline Lanes load(const T* from) {
  Lanes lanes;
  std::memcpy(&lanes, from, sizeof lanes);
  return lanes;
}
template <class Lanes, class T>
inline void store(T* to, const Lanes& lanes) {
  std::memcpy(to, &lanes, sizeof lanes);
}

template <class Lanes>
inline Lanes least(const Lanes& a, const Lanes& b) {
  return a < b ? a : b;
}
template <class Lanes>
inline Lanes greatest(const Lanes& a, const Lanes& b) {
  return a > b ? a : b;
}

// As for single points: the same operations in the same order.
inline Float16 squared_distance(const Float16& ax, const Float16& ay, const Float16& az, float bx, float by, float bz) {
  const Float16 dx = ax - bx, dy = ay - by, dz = az - bz;
  return ((dx * dx) + (dy * dy)) + (dz * dz);
}

// Combine all lanes into one by halving: 64 bytes, 32, 16, then the elements.
template <class T, class Lanes, class Op>
inline T reduce(const Lanes& lanes, Op op) {
  typedef T Half __attribute__((vector_size(32)));
  typedef T Quarter __attribute__((vector_size(16)));
  Half halves[2];
  std::memcpy(halves, &lanes, sizeof halves);
  const Half half = op(halves[0], halves[1]);
  Quarter quarters[2];
  std::memcpy(quarters, &half, sizeof quarters);
  const Quarter quarter = op(quarters[0], quarters[1]);
  T result = quarter[0];
  for (size_t i = 1; i < sizeof(Quarter) / sizeof(T); ++i) result = op(result, quarter[i]);
  return result;
}
template <class T, class Lanes>
inline T lowest_lane(const Lanes& lanes) {
  return reduce<T>(lanes, [](const auto& a, const auto& b) { return least(a, b); });
}
template <class T, class Lanes>
inline T highest_lane(const Lanes& lanes) {
  return reduce<T>(lanes, [](const auto& a, const auto& b) { return greatest(a, b); });
}

inline int32_t sum_of_lanes(const Int16& lanes) {
  return reduce<int32_t>(lanes, [](const auto& a, const auto& b) { return a + b; });
}

// One bit per lane of a comparison's result (all ones or zero).
inline uint32_t bits_of_lanes(const Int16& truth) {
#if defined(__AVX512DQ__)
  return _mm512_movepi32_mask(reinterpret_cast<__m512i>(truth));
#elif defined(__AVX2__)
  __m256 halves[2];
  std::memcpy(halves, &truth, sizeof halves);
  return static_cast<uint32_t>(_mm256_movemask_ps(halves[0]) | _mm256_movemask_ps(halves[1]) << 8);
#else
  uint32_t bits = 0;
  for (int i = 0; i < kLanes; ++i) bits |= static_cast<uint32_t>(truth[i] & 1) << i;
  return bits;
#endif
}

}  // namespace pc
