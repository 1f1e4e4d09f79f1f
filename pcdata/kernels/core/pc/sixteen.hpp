// Sixteen floats or doubles in whatever vector registers the instruction set has: what a search works on.
//
// Arithmetic is GCC's and Clang's vector extension; intrinsics stand only where that has no word for the instruction:
// minimum, maximum, square root and lane masks.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace pc {

#if defined(__AVX512F__) && defined(__AVX512DQ__)
#define PC_AVX512 1
constexpr int kRegisterBytes = 64;
#elif defined(__AVX2__)
constexpr int kRegisterBytes = 32;
#else
constexpr int kRegisterBytes = 16;
#endif

using FloatRegister = float __attribute__((vector_size(kRegisterBytes)));
using DoubleRegister = double __attribute__((vector_size(kRegisterBytes)));
using Int32Register = int32_t __attribute__((vector_size(kRegisterBytes)));
using Int64Register = int64_t __attribute__((vector_size(kRegisterBytes)));

// One bit per lane, lane 0 lowest.
using LaneMask = uint32_t;

namespace registers {

#if defined(PC_AVX512)
// The masked forms compile to the plain instructions; GCC 12 warns of uninitialised values in its own plain ones.
constexpr __mmask16 kAll16 = 0xFFFF;
constexpr __mmask8 kAll8 = 0xFF;
inline FloatRegister minimum(FloatRegister a, FloatRegister b) { return _mm512_maskz_min_ps(kAll16, a, b); }
inline FloatRegister maximum(FloatRegister a, FloatRegister b) { return _mm512_maskz_max_ps(kAll16, a, b); }
inline DoubleRegister minimum(DoubleRegister a, DoubleRegister b) { return _mm512_maskz_min_pd(kAll8, a, b); }
inline DoubleRegister maximum(DoubleRegister a, DoubleRegister b) { return _mm512_maskz_max_pd(kAll8, a, b); }
inline DoubleRegister square_root(DoubleRegister a) { return _mm512_maskz_sqrt_pd(kAll8, a); }
inline LaneMask less(FloatRegister a, FloatRegister b) { return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ); }
inline LaneMask less(DoubleRegister a, DoubleRegister b) { return _mm512_cmp_pd_mask(a, b, _CMP_LT_OQ); }
inline LaneMask less_equal(FloatRegister a, FloatRegister b) { return _mm512_cmp_ps_mask(a, b, _CMP_LE_OQ); }
#elif defined(__AVX2__)
inline FloatRegister minimum(FloatRegister a, FloatRegister b) { return _mm256_min_ps(a, b); }
inline FloatRegister maximum(FloatRegister a, FloatRegister b) { return _mm256_max_ps(a, b); }
inline DoubleRegister minimum(DoubleRegister a, DoubleRegister b) { return _mm256_min_pd(a, b); }
inline DoubleRegister maximum(DoubleRegister a, DoubleRegister b) { return _mm256_max_pd(a, b); }
inline DoubleRegister square_root(DoubleRegister a) { return _mm256_sqrt_pd(a); }
inline LaneMask less(FloatRegister a, FloatRegister b) {
  return static_cast<LaneMask>(_mm256_movemask_ps(_mm256_cmp_ps(a, b, _CMP_LT_OQ)));
}
inline LaneMask less(DoubleRegister a, DoubleRegister b) {
  return static_cast<LaneMask>(_mm256_movemask_pd(_mm256_cmp_pd(a, b, _CMP_LT_OQ)));
}
inline LaneMask less_equal(FloatRegister a, FloatRegister b) {
  return static_cast<LaneMask>(_mm256_movemask_ps(_mm256_cmp_ps(a, b, _CMP_LE_OQ)));
}
#elif defined(__SSE2__)
inline FloatRegister minimum(FloatRegister a, FloatRegister b) { return _mm_min_ps(a, b); }
inline FloatRegister maximum(FloatRegister a, FloatRegister b) { return _mm_max_ps(a, b); }
inline DoubleRegister minimum(DoubleRegister a, DoubleRegister b) { return _mm_min_pd(a, b); }
inline DoubleRegister maximum(DoubleRegister a, DoubleRegister b) { return _mm_max_pd(a, b); }
inline DoubleRegister square_root(DoubleRegister a) { return _mm_sqrt_pd(a); }
inline LaneMask less(FloatRegister a, FloatRegister b) {
  return static_cast<LaneMask>(_mm_movemask_ps(_mm_cmplt_ps(a, b)));
}
inline LaneMask less(DoubleRegister a, DoubleRegister b) {
  return static_cast<LaneMask>(_mm_movemask_pd(_mm_cmplt_pd(a, b)));
}
inline LaneMask less_equal(FloatRegister a, FloatRegister b) {
  return static_cast<LaneMask>(_mm_movemask_ps(_mm_cmple_ps(a, b)));
}
#else
// The same, one element at a time: as on x86, a minimum or maximum with NaN gives the second argument.
template <class Register>
constexpr size_t kWidth = sizeof(Register) / sizeof(Register{}[0]);

template <class Register>
inline Register minimum(Register a, Register b) {
  for (size_t i = 0; i < kWidth<Register>; ++i) a[i] = a[i] < b[i] ? a[i] : b[i];
  return a;
}
template <class Register>
inline Register maximum(Register a, Register b) {
  for (size_t i = 0; i < kWidth<Register>; ++i) a[i] = a[i] > b[i] ? a[i] : b[i];
  return a;
}
inline DoubleRegister square_root(DoubleRegister a) {
  for (size_t i = 0; i < kWidth<DoubleRegister>; ++i) a[i] = std::sqrt(a[i]);
  return a;
}
template <class Register>
inline LaneMask less(Register a, Register b) {
  LaneMask mask = 0;
  for (size_t i = 0; i < kWidth<Register>; ++i) mask |= LaneMask{a[i] < b[i]} << i;
  return mask;
}
inline LaneMask less_equal(FloatRegister a, FloatRegister b) {
  LaneMask mask = 0;
  for (size_t i = 0; i < kWidth<FloatRegister>; ++i) mask |= LaneMask{a[i] <= b[i]} << i;
  return mask;
}
#endif

}  // namespace registers

// Sixteen values of one kind; `Register` holds as many of them as the processor handles at once. The parts are written
// out by a fold, not a loop: GCC keeps an array in registers only when its indices are constants from the start.
template <class Scalar, class Register>
struct Sixteen {
  static constexpr int kLanes = 16;
  static constexpr int kParts = kLanes * int(sizeof(Scalar)) / kRegisterBytes;
  static constexpr int kPerPart = kLanes / kParts;
  Register part[kParts];

  Sixteen() = default;
  explicit Sixteen(Scalar value) {
    *this = each([&](size_t) { return value - Register{}; });
  }
  static Sixteen load(const Scalar* from) {
    return each([&](size_t p) {
      Register loaded;
      std::memcpy(&loaded, from + p * kPerPart, sizeof(loaded));
      return loaded;
    });
  }
  void store(Scalar* to) const {
    each([&](size_t p) { return std::memcpy(to + p * kPerPart, &part[p], sizeof(Register)), part[p]; });
  }

  Scalar operator[](int lane) const { return part[lane / kPerPart][lane % kPerPart]; }

  // The lanes whose parts are body(0), body(1), ...
  template <class Body>
  static Sixteen each(Body&& body) {
    return each(body, std::make_index_sequence<kParts>());
  }
  // The mask whose parts are body(0), body(1), ...
  template <class Body>
  static LaneMask mask(Body&& body) {
    return mask(body, std::make_index_sequence<kParts>());
  }

  friend Sixteen operator+(const Sixteen& a, const Sixteen& b) {
    return each([&](size_t p) { return a.part[p] + b.part[p]; });
  }
  friend Sixteen operator-(const Sixteen& a, const Sixteen& b) {
    return each([&](size_t p) { return a.part[p] - b.part[p]; });
  }
  friend Sixteen operator*(const Sixteen& a, const Sixteen& b) {
    return each([&](size_t p) { return a.part[p] * b.part[p]; });
  }
  friend Sixteen operator/(const Sixteen& a, const Sixteen& b) {
    return each([&](size_t p) { return a.part[p] / b.part[p]; });
  }
  friend Sixteen minimum(const Sixteen& a, const Sixteen& b) {
    return each([&](size_t p) { return registers::minimum(a.part[p], b.part[p]); });
  }
  friend Sixteen maximum(const Sixteen& a, const Sixteen& b) {
    return each([&](size_t p) { return registers::maximum(a.part[p], b.part[p]); });
  }
  friend Sixteen square_root(const Sixteen& a) {
    return each([&](size_t p) { return registers::square_root(a.part[p]); });
  }
  // Like all comparisons false where either is NaN.
  friend LaneMask less(const Sixteen& a, const Sixteen& b) {
    return mask([&](size_t p) { return registers::less(a.part[p], b.part[p]); });
  }
  friend LaneMask less_equal(const Sixteen& a, const Sixteen& b) {
    return mask([&](size_t p) { return registers::less_equal(a.part[p], b.part[p]); });
  }

 private:
  template <class Body, size_t... P>
  static Sixteen each(Body&& body, std::index_sequence<P...>) {
    Sixteen result;
    ((result.part[P] = body(P)), ...);
    return result;
  }
  template <class Body, size_t... P>
  static LaneMask mask(Body&& body, std::index_sequence<P...>) {
    return ((body(P) << (P * kPerPart)) | ...);
  }
};

using Floats = Sixteen<float, FloatRegister>;
using Doubles = Sixteen<double, DoubleRegister>;

inline float largest(const Floats& a) {
  float lane[Floats::kLanes];
  a.store(lane);
  for (int width = Floats::kLanes / 2; width > 0; width /= 2)
    for (int i = 0; i < width; ++i) lane[i] = lane[i] > lane[i + width] ? lane[i] : lane[i + width];
  return lane[0];
}

inline Doubles widen(const Floats& a) {
  using Narrow = float __attribute__((vector_size(kRegisterBytes / 2)));
  constexpr size_t kNarrow = sizeof(Narrow) / sizeof(float);
  return Doubles::each([&](size_t p) {
    Narrow half;
    std::memcpy(&half, reinterpret_cast<const float*>(&a.part[p / 2]) + p % 2 * kNarrow, sizeof(half));
    return __builtin_convertvector(half, DoubleRegister);
  });
}

// The values of the lanes in `mask`, 0 in the others.
template <class Scalar, class Register>
Sixteen<Scalar, Register> keep(LaneMask mask, const Sixteen<Scalar, Register>& value) {
  using All = Sixteen<Scalar, Register>;
  return All::each([&](size_t p) -> Register {
    const LaneMask chosen = mask >> (p * All::kPerPart);
#if defined(PC_AVX512)
    if constexpr (sizeof(Scalar) == 4) return _mm512_maskz_mov_ps(static_cast<__mmask16>(chosen), value.part[p]);
    else return _mm512_maskz_mov_pd(static_cast<__mmask8>(chosen), value.part[p]);
#else
    using Integers = std::conditional_t<sizeof(Scalar) == 4, Int32Register, Int64Register>;
    Integers bit;
    for (int i = 0; i < All::kPerPart; ++i) bit[i] = 1 << i;
    const Integers all = (bit & (Integers{} + static_cast<int32_t>(chosen))) == bit;
    return reinterpret_cast<Register>(reinterpret_cast<Integers>(value.part[p]) & all);
#endif
  });
}

// Squared distance as every backend computes it: ((dx*dx)+(dy*dy))+(dz*dz) in float, never fused.
inline Floats squared_length(const Floats& dx, const Floats& dy, const Floats& dz) {
  return (dx * dx + dy * dy) + dz * dz;
}

}  // namespace pc
