// As many numbers as a register holds, handled as one, with the compilers' vector extension: 16 with AVX-512, 8 with
// AVX2, 4 with SSE2. For short loops with reductions, which compilers do not vectorise reliably. (GCC takes
// conditionals on vectors wider than a register apart into single numbers.)
#pragma once

#include "pc/common.hpp"
#include "pc/math/distance.hpp"

#if defined(__SSE2__)
#include <immintrin.h>
#endif

// Lanes are passed between inline functions only, so no calling convention is at stake.
#pragma GCC diagnostic ignored "-Wpsabi"

namespace pc {

#if defined(__AVX512DQ__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float FloatLanes __attribute__((vector_size(4 * kLanes)));
typedef int32_t IntLanes __attribute__((vector_size(4 * kLanes)));
typedef uint32_t UintLanes __attribute__((vector_size(4 * kLanes)));
typedef int64_t LongLanes __attribute__((vector_size(4 * kLanes)));  // half as many

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
inline FloatLanes squared_distance(const FloatLanes& ax, const FloatLanes& ay, const FloatLanes& az, float bx, float by,
                                   float bz) {
  const FloatLanes dx = ax - bx, dy = ay - by, dz = az - bz;
  return ((dx * dx) + (dy * dy)) + (dz * dz);
}

// Combine all lanes into one, halving while there are more than 16 bytes.
template <class T, class Lanes, class Op>
inline T reduce(const Lanes& lanes, const Op& op) {
  if constexpr (sizeof(Lanes) > 16) {
    typedef T Half __attribute__((vector_size(sizeof(Lanes) / 2)));
    Half halves[2];
    std::memcpy(halves, &lanes, sizeof halves);
    return reduce<T, Half>(op(halves[0], halves[1]), op);
  } else {
    T result = lanes[0];
    for (size_t i = 1; i < sizeof(Lanes) / sizeof(T); ++i) result = op(result, lanes[i]);
    return result;
  }
}
template <class T, class Lanes>
inline T lowest_lane(const Lanes& lanes) {
  return reduce<T>(lanes, [](const auto& a, const auto& b) { return least(a, b); });
}
template <class T, class Lanes>
inline T highest_lane(const Lanes& lanes) {
  return reduce<T>(lanes, [](const auto& a, const auto& b) { return greatest(a, b); });
}

inline int32_t sum_of_lanes(const IntLanes& lanes) {
  return reduce<int32_t>(lanes, [](const auto& a, const auto& b) { return a + b; });
}

// One bit per lane of a comparison's result (all ones or zero).
inline uint32_t bits_of_lanes(const IntLanes& truth) {
#if defined(__AVX512DQ__)
  return _mm512_movepi32_mask(reinterpret_cast<__m512i>(truth));
#elif defined(__AVX2__)
  return static_cast<uint32_t>(_mm256_movemask_ps(reinterpret_cast<__m256>(truth)));
#elif defined(__SSE2__)
  return static_cast<uint32_t>(_mm_movemask_ps(reinterpret_cast<__m128>(truth)));
#else
  uint32_t bits = 0;
  for (int i = 0; i < kLanes; ++i) bits |= static_cast<uint32_t>(truth[i] & 1) << i;
  return bits;
#endif
}

}  // namespace pc
