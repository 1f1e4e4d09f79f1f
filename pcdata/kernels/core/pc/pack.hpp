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
  template <class Body, size_t... P>
  static PackMask mask(Body&& body, std::index_sequence<P...>) {
    return ((body(P) << (P * kPerPart)) | ...);
  }
};

using FloatPack = Pack<float, FloatRegister>;
using DoublePack = Pack<double, DoubleRegister>;

inline float largest(const FloatPack& a) {
  float lane[kPackLanes];
  a.store(lane);
  for (int width = kPackLanes / 2; width > 0; width /= 2)
    for (int i = 0; i < width; ++i) lane[i] = lane[i] > lane[i + width] ? lane[i] : lane[i + width];
  return lane[0];
}

inline DoublePack widen(const FloatPack& a) {
  using Narrow = float __attribute__((vector_size(kRegisterBytes / 2)));
  constexpr size_t kNarrow = sizeof(Narrow) / sizeof(float);
  return DoublePack::each([&](size_t p) {
    const auto half = load<Narrow>(reinterpret_cast<const float*>(&a.part[p / 2]) + p % 2 * kNarrow);
    return __builtin_convertvector(half, DoubleRegister);
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
