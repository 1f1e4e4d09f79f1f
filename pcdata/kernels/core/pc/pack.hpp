// Sixteen numbers in as many registers as that takes.
#pragma once

#include "pc/simd.hpp"

namespace pc {

constexpr int kPackLanes = 16;

// One bit per lane of a pack, lane 0 lowest.
using PackMask = uint32_t;

inline uint32_t less_bits(const FloatRegister& a, const FloatRegister& b) { return less(a, b).bits(); }
inline uint32_t less_equal_bits(const FloatRegister& a, const FloatRegister& b) { return less_equal(a, b).bits(); }

// The parts are written out by a fold, not a loop: GCC keeps an array in registers only when its indices are constants
// from the start.
template <class Scalar, class Register>
struct Pack {
  static constexpr int kParts = kPackLanes * int(sizeof(Scalar)) / kRegisterBytes;
  static constexpr int kPerPart = kPackLanes / kParts;
  Register part[kParts];

  Pack() = default;
  explicit Pack(Scalar value) {
    *this = each([&](size_t) { return value - Register{}; });
  }
  static Pack load(const Scalar* from) {
    return each([&](size_t p) { return pc::load<Register>(from + p * kPerPart); });
  }
  void store(Scalar* to) const {
    each([&](size_t p) { return pc::store(to + p * kPerPart, part[p]), part[p]; });
  }

  Scalar operator[](int lane) const { return part[lane / kPerPart][lane % kPerPart]; }

  // All parts made one by `op`.
  template <class Op>
  Register combined(const Op& op) const {
    Register result = part[0];
    for (int p = 1; p < kParts; ++p) result = op(result, part[p]);
    return result;
  }

  // The pack whose parts are body(0), body(1), ...
  template <class Body>
  static Pack each(Body&& body) {
    return each(body, std::make_index_sequence<kParts>());
  }
  // The mask whose parts are body(0), body(1), ...
  template <class Body>
  static PackMask mask(Body&& body) {
    return mask(body, std::make_index_sequence<kParts>());
  }

  friend Pack operator+(const Pack& a, const Pack& b) {
    return each([&](size_t p) { return a.part[p] + b.part[p]; });
  }
  friend Pack operator-(const Pack& a, const Pack& b) {
    return each([&](size_t p) { return a.part[p] - b.part[p]; });
  }
  friend Pack operator*(const Pack& a, const Pack& b) {
    return each([&](size_t p) { return a.part[p] * b.part[p]; });
  }
  friend Pack operator/(const Pack& a, const Pack& b) {
    return each([&](size_t p) { return a.part[p] / b.part[p]; });
  }
  friend Pack minimum(const Pack& a, const Pack& b) {
    return each([&](size_t p) { return pc::minimum(a.part[p], b.part[p]); });
  }
  friend Pack maximum(const Pack& a, const Pack& b) {
    return each([&](size_t p) { return pc::maximum(a.part[p], b.part[p]); });
  }
  friend Pack square_root(const Pack& a) {
    return each([&](size_t p) { return pc::square_root(a.part[p]); });
  }
  friend PackMask less(const Pack& a, const Pack& b) {
    return mask([&](size_t p) { return pc::less_bits(a.part[p], b.part[p]); });
  }
  // Whether any lane of a is less than that of b.
  friend bool any_less(const Pack& a, const Pack& b) { return any_less(a, b, std::make_index_sequence<kParts>()); }
  friend PackMask less_equal(const Pack& a, const Pack& b) {
    return mask([&](size_t p) { return pc::less_equal_bits(a.part[p], b.part[p]); });
  }

 private:
  template <class Body, size_t... P>
  static Pack each(Body&& body, std::index_sequence<P...>) {
    Pack result;
    ((result.part[P] = body(P)), ...);
    return result;
  }
  template <size_t... P>
  static bool any_less(const Pack& a, const Pack& b, std::index_sequence<P...>) {
    return any((pc::less(a.part[P], b.part[P]) | ...));
  }
  template <class Body, size_t... P>
  static PackMask mask(Body&& body, std::index_sequence<P...>) {
    return ((body(P) << (P * kPerPart)) | ...);
  }
};

using FloatPack = Pack<float, FloatRegister>;
using DoublePack = Pack<double, DoubleRegister>;

// Of lanes that are no NaN.
inline float largest(const FloatPack& a) {
  return highest_lane<float>(a.combined([](const auto& b, const auto& c) { return maximum(b, c); }));
}
inline float smallest(const FloatPack& a) {
  return lowest_lane<float>(a.combined([](const auto& b, const auto& c) { return minimum(b, c); }));
}

inline DoublePack widen(const FloatPack& a) {
  return DoublePack::each([&](size_t p) -> DoubleRegister {
#if defined(PC_AVX512)
    // Compilers know no other way from half a register than by memory.
    const __m512 all = native(a.part[0]);
    return _mm512_maskz_cvtps_pd(kAll8,
                                 p == 0 ? _mm512_castps512_ps256(all) : _mm512_maskz_extractf32x8_ps(kAll8, all, 1));
#elif defined(__AVX2__)
    const auto all = reinterpret_cast<__m256>(a.part[p / 2]);
    return _mm256_cvtps_pd(p % 2 == 0 ? _mm256_castps256_ps128(all) : _mm256_extractf128_ps(all, 1));
#else
    using Narrow = float __attribute__((vector_size(kRegisterBytes / 2)));
    constexpr size_t kNarrow = sizeof(Narrow) / sizeof(float);
    const auto half = load<Narrow>(reinterpret_cast<const float*>(&a.part[p / 2]) + p % 2 * kNarrow);
    return __builtin_convertvector(half, DoubleRegister);
#endif
  });
}

// The values of the lanes in `mask`, 0 in the others.
template <class Scalar, class Register>
Pack<Scalar, Register> keep(PackMask mask, const Pack<Scalar, Register>& value) {
  using All = Pack<Scalar, Register>;
  return All::each([&](size_t p) -> Register {
    const PackMask chosen = mask >> (p * All::kPerPart);
#if defined(PC_AVX512)
    if constexpr (sizeof(Scalar) == 4)
      return _mm512_maskz_mov_ps(static_cast<__mmask16>(chosen), value.part[p]);
    else
      return _mm512_maskz_mov_pd(static_cast<__mmask8>(chosen), value.part[p]);
#else
    using Integers = std::conditional_t<sizeof(Scalar) == 4, Int32Register, Int64Register>;
    Integers bit;
    for (int i = 0; i < All::kPerPart; ++i) bit[i] = 1 << i;
    const Integers all = (bit & (Integers{} + static_cast<int32_t>(chosen))) == bit;
    return reinterpret_cast<Register>(reinterpret_cast<Integers>(value.part[p]) & all);
#endif
  });
}

}  // namespace pc
