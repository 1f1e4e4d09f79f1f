// Numbers handled side by side.
//
// A register (FloatRegister, Int32Register, ...) holds as many as the processor handles at once: 16 floats with
// AVX-512, 8 with AVX2, 4 with SSE2 and NEON. A pack (FloatPack, DoublePack) holds sixteen whatever the processor, in
// one to eight registers: what a search for sixteen queries works on.
//
// Arithmetic and comparisons are GCC's and Clang's vector extension; intrinsics stand only where it has no word for an
// instruction, or where compilers do not find it.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

#if defined(__SSE2__)
#include <immintrin.h>
#elif defined(__aarch64__) && defined(__ARM_NEON)
#include <arm_neon.h>
#define PC_NEON 1
#endif

// Registers are passed between inline functions only, so no calling convention is at stake.
#pragma GCC diagnostic ignored "-Wpsabi"

namespace pc {

#if defined(__AVX512F__) && defined(__AVX512DQ__)
#define PC_AVX512 1
constexpr int kRegisterBytes = 64;
#elif defined(__AVX2__)
constexpr int kRegisterBytes = 32;
#else
constexpr int kRegisterBytes = 16;
#endif
constexpr int kLanes = kRegisterBytes / 4;

// GCC takes conditionals on vectors wider than a register apart into single numbers: none is.
typedef float FloatRegister __attribute__((vector_size(kRegisterBytes)));
typedef double DoubleRegister __attribute__((vector_size(kRegisterBytes)));
typedef int32_t Int32Register __attribute__((vector_size(kRegisterBytes)));
typedef int64_t Int64Register __attribute__((vector_size(kRegisterBytes)));

template <class Register, class T>
inline Register load(const T* from) {
  Register lanes;
  std::memcpy(&lanes, from, sizeof lanes);
  return lanes;
}
template <class Register, class T>
inline void store(T* to, const Register& lanes) {
  std::memcpy(to, &lanes, sizeof lanes);
}

// The first `count` numbers, or as many as there are lanes; the rest is 0.
inline FloatRegister load_up_to(const float* from, int64_t count) {
  if (count >= kLanes) return load<FloatRegister>(from);
  FloatRegister lanes = {};
  std::memcpy(&lanes, from, static_cast<size_t>(count) * sizeof(float));
  return lanes;
}

// -- smaller and larger: of NaN and a number, or of 0 and -0, the second ------------------------------------------

template <class T>
inline T minimum(const T& a, const T& b) {
  return a < b ? a : b;
}
template <class T>
inline T maximum(const T& a, const T& b) {
  return a > b ? a : b;
}

#if defined(PC_AVX512)
// The masked forms compile to the plain instructions; GCC 12 warns of uninitialized values in its own plain ones.
constexpr __mmask16 kAll16 = 0xFFFF;
constexpr __mmask8 kAll8 = 0xFF;
inline FloatRegister minimum(const FloatRegister& a, const FloatRegister& b) {
  return _mm512_maskz_min_ps(kAll16, a, b);
}
inline FloatRegister maximum(const FloatRegister& a, const FloatRegister& b) {
  return _mm512_maskz_max_ps(kAll16, a, b);
}
inline DoubleRegister minimum(const DoubleRegister& a, const DoubleRegister& b) {
  return _mm512_maskz_min_pd(kAll8, a, b);
}
inline DoubleRegister maximum(const DoubleRegister& a, const DoubleRegister& b) {
  return _mm512_maskz_max_pd(kAll8, a, b);
}
inline FloatRegister square_root(const FloatRegister& a) { return _mm512_maskz_sqrt_ps(kAll16, a); }
#elif defined(__AVX2__)
inline FloatRegister minimum(const FloatRegister& a, const FloatRegister& b) { return _mm256_min_ps(a, b); }
inline FloatRegister maximum(const FloatRegister& a, const FloatRegister& b) { return _mm256_max_ps(a, b); }
inline DoubleRegister minimum(const DoubleRegister& a, const DoubleRegister& b) { return _mm256_min_pd(a, b); }
inline DoubleRegister maximum(const DoubleRegister& a, const DoubleRegister& b) { return _mm256_max_pd(a, b); }
inline FloatRegister square_root(const FloatRegister& a) { return _mm256_sqrt_ps(a); }
#elif defined(__SSE2__)
inline FloatRegister minimum(const FloatRegister& a, const FloatRegister& b) { return _mm_min_ps(a, b); }
inline FloatRegister maximum(const FloatRegister& a, const FloatRegister& b) { return _mm_max_ps(a, b); }
inline DoubleRegister minimum(const DoubleRegister& a, const DoubleRegister& b) { return _mm_min_pd(a, b); }
inline DoubleRegister maximum(const DoubleRegister& a, const DoubleRegister& b) { return _mm_max_pd(a, b); }
inline FloatRegister square_root(const FloatRegister& a) { return _mm_sqrt_ps(a); }
#elif defined(PC_NEON)
// Its own minimum and maximum of NaN and a number are NaN.
inline FloatRegister square_root(const FloatRegister& a) {
  return reinterpret_cast<FloatRegister>(vsqrtq_f32(reinterpret_cast<float32x4_t>(a)));
}
#else
inline FloatRegister square_root(FloatRegister a) {
  for (int i = 0; i < kLanes; ++i) a[i] = std::sqrt(a[i]);
  return a;
}
#endif

// Put two numbers in order, neither of them NaN or a negative one but -infinity: what is left has the bits of an
// integer that ascends with the number. Processors compare integers and floats in different units (Zen 4 integers twice
// as fast), so that one of each takes half the time of two alike.
inline void put_in_order(FloatRegister& low, FloatRegister& high) {
  const FloatRegister a = low, b = high;
#if defined(PC_AVX512)
  low = reinterpret_cast<FloatRegister>(
      _mm512_maskz_min_epi32(kAll16, reinterpret_cast<__m512i>(a), reinterpret_cast<__m512i>(b)));
#elif defined(__AVX2__)
  low = reinterpret_cast<FloatRegister>(_mm256_min_epi32(reinterpret_cast<__m256i>(a), reinterpret_cast<__m256i>(b)));
#else
  low = minimum(a, b);
#endif
  high = maximum(a, b);
}

inline FloatRegister magnitude(const FloatRegister& value) {
  return reinterpret_cast<FloatRegister>(reinterpret_cast<Int32Register>(value) & 0x7FFFFFFF);
}

// Squared length as every backend computes it: ((dx*dx)+(dy*dy))+(dz*dz), never fused.
template <class T>
inline T squared_length(const T& dx, const T& dy, const T& dz) {
  return (dx * dx + dy * dy) + dz * dz;
}

// Combine all lanes into one, halving while there are more than 16 bytes.
template <class T, class Register, class Op>
inline T reduce(const Register& lanes, const Op& op) {
  if constexpr (sizeof(Register) > 16) {
    typedef T Half __attribute__((vector_size(sizeof(Register) / 2)));
    Half halves[2];
    std::memcpy(halves, &lanes, sizeof halves);
    return reduce<T, Half>(op(halves[0], halves[1]), op);
  } else {
    T result = lanes[0];
    for (size_t i = 1; i < sizeof(Register) / sizeof(T); ++i) result = op(result, lanes[i]);
    return result;
  }
}
template <class T, class Register>
inline T lowest_lane(const Register& lanes) {
  return reduce<T>(lanes, [](const auto& a, const auto& b) { return minimum(a, b); });
}
template <class T, class Register>
inline T highest_lane(const Register& lanes) {
  return reduce<T>(lanes, [](const auto& a, const auto& b) { return maximum(a, b); });
}
inline int32_t sum_of_lanes(const Int32Register& lanes) {
  return reduce<int32_t>(lanes, [](const auto& a, const auto& b) { return a + b; });
}

// -- comparisons: false where either is NaN -----------------------------------------------------------------------

// What a comparison gives, in the form that the processor computes it: one bit per lane with AVX-512, else all ones or
// zero in each. bits() has lane 0 lowest.
#if defined(PC_AVX512)
struct RegisterMask {
  __mmask16 native;

  uint32_t bits() const { return native; }
  RegisterMask operator&(RegisterMask other) const { return {static_cast<__mmask16>(native & other.native)}; }
  RegisterMask operator|(RegisterMask other) const { return {static_cast<__mmask16>(native | other.native)}; }
};

inline __m512 native(const FloatRegister& lanes) { return reinterpret_cast<__m512>(lanes); }
inline __m512i native(const Int32Register& lanes) { return reinterpret_cast<__m512i>(lanes); }
inline RegisterMask less(const FloatRegister& a, const FloatRegister& b) {
  return {_mm512_cmp_ps_mask(native(a), native(b), _CMP_LT_OQ)};
}
inline RegisterMask less_equal(const FloatRegister& a, const FloatRegister& b) {
  return {_mm512_cmp_ps_mask(native(a), native(b), _CMP_LE_OQ)};
}
inline RegisterMask less(const Int32Register& a, const Int32Register& b) {
  return {_mm512_cmplt_epi32_mask(native(a), native(b))};
}
inline RegisterMask equal(const Int32Register& a, const Int32Register& b) {
  return {_mm512_cmpeq_epi32_mask(native(a), native(b))};
}
inline RegisterMask unequal(const Int32Register& a, const Int32Register& b) {
  return {_mm512_cmpneq_epi32_mask(native(a), native(b))};
}
inline FloatRegister select(RegisterMask mask, const FloatRegister& a, const FloatRegister& b) {
  return reinterpret_cast<FloatRegister>(_mm512_mask_blend_ps(mask.native, native(b), native(a)));
}
inline Int32Register select(RegisterMask mask, const Int32Register& a, const Int32Register& b) {
  return reinterpret_cast<Int32Register>(_mm512_mask_blend_epi32(mask.native, native(b), native(a)));
}
inline RegisterMask all_lanes() { return {0xffff}; }
inline uint32_t less_bits(const DoubleRegister& a, const DoubleRegister& b) {
  return _mm512_cmp_pd_mask(a, b, _CMP_LT_OQ);
}
#else
struct RegisterMask {
  Int32Register native;

  uint32_t bits() const {
#if defined(__AVX2__)
    return static_cast<uint32_t>(_mm256_movemask_ps(reinterpret_cast<__m256>(native)));
#elif defined(__SSE2__)
    return static_cast<uint32_t>(_mm_movemask_ps(reinterpret_cast<__m128>(native)));
#elif defined(PC_NEON)
    constexpr Int32Register places = {1, 2, 4, 8};
    return vaddvq_u32(reinterpret_cast<uint32x4_t>(native & places));
#else
    uint32_t bits = 0;
    for (int i = 0; i < kLanes; ++i) bits |= static_cast<uint32_t>(native[i] & 1) << i;
    return bits;
#endif
  }
  RegisterMask operator&(const RegisterMask& other) const { return {native & other.native}; }
  RegisterMask operator|(const RegisterMask& other) const { return {native | other.native}; }
};

inline RegisterMask less(const FloatRegister& a, const FloatRegister& b) { return {a < b}; }
inline RegisterMask less_equal(const FloatRegister& a, const FloatRegister& b) { return {a <= b}; }
inline RegisterMask less(const Int32Register& a, const Int32Register& b) { return {a < b}; }
inline RegisterMask equal(const Int32Register& a, const Int32Register& b) { return {a == b}; }
inline RegisterMask unequal(const Int32Register& a, const Int32Register& b) { return {a != b}; }
template <class Register>
inline Register select(const RegisterMask& mask, const Register& a, const Register& b) {
  return mask.native ? a : b;
}
inline RegisterMask all_lanes() { return {Int32Register{} - 1}; }
inline uint32_t less_bits(const DoubleRegister& a, const DoubleRegister& b) {
#if defined(__AVX2__)
  return static_cast<uint32_t>(_mm256_movemask_pd(reinterpret_cast<__m256d>(a < b)));
#elif defined(__SSE2__)
  return static_cast<uint32_t>(_mm_movemask_pd(reinterpret_cast<__m128d>(a < b)));
#else
  uint32_t bits = 0;
  for (int i = 0; i < kLanes / 2; ++i) bits |= static_cast<uint32_t>(a[i] < b[i]) << i;
  return bits;
#endif
}
#endif

inline bool any(const RegisterMask& mask) { return mask.bits() != 0; }

// Write the chosen lanes one behind the other and return how many they are; up to a register is written.
inline int store_chosen(int32_t* to, const Int32Register& lanes, RegisterMask chosen) {
#if defined(PC_AVX512)
  _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(chosen.native, native(lanes)));
#else
  int count = 0;
  for (uint32_t bits = chosen.bits(); bits != 0; bits &= bits - 1) to[count++] = lanes[__builtin_ctz(bits)];
#endif
  return __builtin_popcount(chosen.bits());
}
inline int store_chosen(float* to, const FloatRegister& lanes, RegisterMask chosen) {
#if defined(PC_AVX512)
  _mm512_storeu_ps(to, _mm512_maskz_compress_ps(chosen.native, native(lanes)));
#else
  int count = 0;
  for (uint32_t bits = chosen.bits(); bits != 0; bits &= bits - 1) to[count++] = lanes[__builtin_ctz(bits)];
#endif
  return __builtin_popcount(chosen.bits());
}

// -- conversions and gathers --------------------------------------------------------------------------------------

typedef int16_t Int16Lanes __attribute__((vector_size(2 * kLanes)));

inline Int32Register widened(const int16_t* from) {
  return __builtin_convertvector(load<Int16Lanes>(from), Int32Register);
}
inline void store_narrowed(int16_t* to, const Int32Register& lanes) {
  store(to, __builtin_convertvector(lanes, Int16Lanes));
}
inline FloatRegister as_float(const Int32Register& lanes) { return __builtin_convertvector(lanes, FloatRegister); }
inline Int32Register truncated(const FloatRegister& lanes) { return __builtin_convertvector(lanes, Int32Register); }

// The greatest integer that is not above; INT32_MIN for what no int32 holds.
inline Int32Register floored(const FloatRegister& x) {
#if defined(PC_AVX512)
  constexpr int down = _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC;
  return reinterpret_cast<Int32Register>(_mm512_maskz_cvt_roundps_epi32(kAll16, native(x), down));
#elif defined(__AVX2__)
  return reinterpret_cast<Int32Register>(_mm256_cvtps_epi32(_mm256_floor_ps(reinterpret_cast<__m256>(x))));
#elif defined(PC_NEON)
  const Int32Register whole = reinterpret_cast<Int32Register>(vcvtmq_s32_f32(reinterpret_cast<float32x4_t>(x)));
  const Int32Register held = (x >= -2147483648.0f) & (x < 2147483648.0f);  // NEON gives 0 for NaN, else the nearest
  return held ? whole : Int32Register{} + INT32_MIN;
#else
  const Int32Register whole = truncated(x);
  return whole + (as_float(whole) > x);  // a comparison is -1 where it holds
#endif
}

// The nearest integer, the even one of two; for values below 2^22.
inline Int32Register rounded(const FloatRegister& x) {
#if defined(PC_AVX512)
  return reinterpret_cast<Int32Register>(_mm512_maskz_cvtps_epi32(kAll16, native(x)));
#elif defined(__AVX2__)
  return reinterpret_cast<Int32Register>(_mm256_cvtps_epi32(reinterpret_cast<__m256>(x)));
#elif defined(PC_NEON)
  return reinterpret_cast<Int32Register>(vcvtnq_s32_f32(reinterpret_cast<float32x4_t>(x)));
#else
  constexpr float shift = 12582912.0f;
  return truncated((x + shift) - shift);
#endif
}

inline FloatRegister gather(const float* from, const Int32Register& index) {
#if defined(PC_AVX512)
  return _mm512_i32gather_ps(native(index), from, 4);
#elif defined(__AVX2__)
  return _mm256_i32gather_ps(from, reinterpret_cast<__m256i>(index), 4);
#else
  FloatRegister result;
  for (int i = 0; i < kLanes; ++i) result[i] = from[index[i]];
  return result;
#endif
}
inline Int32Register gather(const int32_t* from, const Int32Register& index) {
  return reinterpret_cast<Int32Register>(gather(reinterpret_cast<const float*>(from), index));
}

// Points that follow each other, x y z each, as one register per coordinate.
inline void load_points(const float* from, FloatRegister& x, FloatRegister& y, FloatRegister& z) {
#if defined(PC_AVX512)
  const auto a = native(load<FloatRegister>(from)), b = native(load<FloatRegister>(from + 16)),
             c = native(load<FloatRegister>(from + 32));
  // Places beyond 15 are in the second source; of the third, where the first two have no more.
  const auto pick = [&](__m512i from_ab, __m512i from_c) {
    return reinterpret_cast<FloatRegister>(_mm512_permutex2var_ps(_mm512_permutex2var_ps(a, from_ab, b), from_c, c));
  };
  x = pick(_mm512_setr_epi32(0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0),
           _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29));
  y = pick(_mm512_setr_epi32(1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0),
           _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30));
  z = pick(_mm512_setr_epi32(2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0),
           _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31));
#elif defined(__SSE2__)
  // Four points in three registers of four; AVX2 does twice that in its two halves.
  const auto quarter = [](const float* at) { return _mm_loadu_ps(at); };
#if defined(__AVX2__)
  const auto both = [&](int k) {
    return _mm256_insertf128_ps(_mm256_castps128_ps256(quarter(from + 4 * k)), quarter(from + 12 + 4 * k), 1);
  };
  const __m256 a = both(0), b = both(1), c = both(2);
#define PC_SHUFFLE _mm256_shuffle_ps
#else
  const __m128 a = quarter(from), b = quarter(from + 4), c = quarter(from + 8);
#define PC_SHUFFLE _mm_shuffle_ps
#endif
  const auto late = PC_SHUFFLE(b, c, _MM_SHUFFLE(2, 1, 3, 2));   // x2 y2 x3 y3
  const auto early = PC_SHUFFLE(a, b, _MM_SHUFFLE(1, 0, 2, 1));  // y0 z0 y1 z1
  x = reinterpret_cast<FloatRegister>(PC_SHUFFLE(a, late, _MM_SHUFFLE(2, 0, 3, 0)));
  y = reinterpret_cast<FloatRegister>(PC_SHUFFLE(early, late, _MM_SHUFFLE(3, 1, 2, 0)));
  z = reinterpret_cast<FloatRegister>(PC_SHUFFLE(early, c, _MM_SHUFFLE(3, 0, 3, 1)));
#undef PC_SHUFFLE
#elif defined(PC_NEON)
  const float32x4x3_t axes = vld3q_f32(from);
  x = reinterpret_cast<FloatRegister>(axes.val[0]);
  y = reinterpret_cast<FloatRegister>(axes.val[1]);
  z = reinterpret_cast<FloatRegister>(axes.val[2]);
#else
  for (int i = 0; i < kLanes; ++i) x[i] = from[3 * i], y[i] = from[3 * i + 1], z[i] = from[3 * i + 2];
#endif
}

// One bit per number of 64: whether it is negative.
inline uint64_t signs_of(const int8_t* numbers) {
#if defined(__AVX512BW__)
  return _mm512_movepi8_mask(_mm512_loadu_si512(numbers));
#elif defined(__SSE2__)
  uint64_t bits = 0;
  for (int i = 0; i < 4; ++i) {
    const __m128i some = _mm_loadu_si128(reinterpret_cast<const __m128i*>(numbers + 16 * i));
    bits |= static_cast<uint64_t>(static_cast<uint32_t>(_mm_movemask_epi8(some))) << 16 * i;
  }
  return bits;
#elif defined(PC_NEON)
  constexpr uint8_t kPlaces[16] = {1, 2, 4, 8, 16, 32, 64, 128, 1, 2, 4, 8, 16, 32, 64, 128};
  const uint8x16_t places = vld1q_u8(kPlaces);
  uint8x16_t some[4];
  for (int i = 0; i < 4; ++i) some[i] = vandq_u8(vcltzq_s8(vld1q_s8(numbers + 16 * i)), places);
  const uint8x16_t pairs = vpaddq_u8(vpaddq_u8(some[0], some[1]), vpaddq_u8(some[2], some[3]));
  return vgetq_lane_u64(vreinterpretq_u64_u8(vpaddq_u8(pairs, pairs)), 0);
#else
  uint64_t bits = 0;
  for (int i = 0; i < 64; ++i) bits |= static_cast<uint64_t>(numbers[i] < 0) << i;
  return bits;
#endif
}
inline uint64_t signs_of(const int16_t* numbers) {
#if defined(__AVX512BW__)
  const uint64_t low = _mm512_movepi16_mask(_mm512_loadu_si512(numbers));
  return low | static_cast<uint64_t>(_mm512_movepi16_mask(_mm512_loadu_si512(numbers + 32))) << 32;
#elif defined(__SSE2__)
  uint64_t bits = 0;
  for (int i = 0; i < 4; ++i) {
    const auto* const from = reinterpret_cast<const __m128i*>(numbers + 16 * i);
    const __m128i some = _mm_packs_epi16(_mm_loadu_si128(from), _mm_loadu_si128(from + 1));
    bits |= static_cast<uint64_t>(static_cast<uint32_t>(_mm_movemask_epi8(some))) << 16 * i;
  }
  return bits;
#else
  int8_t narrow[64];
  for (int i = 0; i < 64; ++i) narrow[i] = static_cast<int8_t>(numbers[i] >> 8);
  return signs_of(narrow);
#endif
}

}  // namespace pc
