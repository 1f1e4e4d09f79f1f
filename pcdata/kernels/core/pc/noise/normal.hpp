// Words of random streams, and normal numbers of them: those of pcdata/rng.py and pcdata/functional/noise.py, bit for
// bit. Loops over small arrays, which compilers turn into vector code.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

namespace pc::noise {

constexpr int kPairs = 96;  // worked on at once: three of every two points of a block

// Word number `number` of the stream of a key (SplitMix64).
inline uint64_t word(uint64_t key, uint64_t number) {
  uint64_t mixed = key + (number + 1) * 0x9E3779B97F4A7C15u;
  mixed = (mixed ^ (mixed >> 30)) * 0xBF58476D1CE4E5B9u;
  mixed = (mixed ^ (mixed >> 27)) * 0x94D049BB133111EBu;
  return mixed ^ (mixed >> 31);
}

inline float as_float(int32_t bits) {
  float value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}
inline int32_t as_bits(float value) {
  int32_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  return bits;
}

template <int kCount>
inline float polynomial(const float (&coefficients)[kCount], float x) {
  float value = coefficients[kCount - 1];
  for (int i = kCount - 2; i >= 0; --i) value = value * x + coefficients[i];
  return value;
}

// Two normal numbers of each of the words first, first + 1, ... of a stream.
inline void normal_pairs(uint64_t key, uint64_t first, float (&one)[kPairs], float (&other)[kPairs]) {
  constexpr float kLogarithm[] = {1.0f,         -0.49999988f, 0.33334184f, -0.25002155f, 0.19956978f,
                                  -0.16560696f, 0.14949095f,  -0.1437733f, 0.087439455f};
  constexpr float kSine[] = {1.5707964f, -0.6459635f, 0.07968022f, -0.004602163f};
  constexpr float kCosine[] = {1.0f, -1.2337005f, 0.2536692f, -0.02086007f, 0.0009036299f};
  constexpr float kLog2 = 0.693147182464599609375f, kStep = 1.0f / 16777216;

  int32_t upper[kPairs], lower[kPairs];
  for (int i = 0; i < kPairs; ++i) {
    const uint64_t mixed = word(key, first + static_cast<uint64_t>(i));
    upper[i] = static_cast<int32_t>(mixed >> 40);
    lower[i] = static_cast<int32_t>(mixed);
  }
  for (int i = 0; i < kPairs; ++i) {
    const int32_t bits = as_bits((static_cast<float>(upper[i]) + 0.5f) * kStep);
    const int32_t exponent = (bits - 0x3F3504F3) >> 23;
    const float f = as_float(bits - static_cast<int32_t>(static_cast<uint32_t>(exponent) << 23)) - 1.0f;
    const float log = polynomial(kLogarithm, f) * f + static_cast<float>(exponent) * kLog2;
    const float squared = log * -2.0f;
    const float radius = std::sqrt(squared > 0.0f ? squared : 0.0f);
    const int32_t fraction = (lower[i] & 0x3FFFFFFF) >> 6;
    const float angle = (static_cast<float>(fraction) + 0.5f) * kStep - 0.5f;
    const float square = angle * angle;
    const int32_t sine = as_bits(polynomial(kSine, square) * angle);
    const int32_t cosine = as_bits(polynomial(kCosine, square));
    const uint32_t quadrant = static_cast<uint32_t>(lower[i]) >> 30;
    const int32_t odd = -static_cast<int32_t>(quadrant & 1u);  // all bits where they change places
    const int32_t change = (sine ^ cosine) & odd;
    const int32_t one_sign = static_cast<int32_t>(((quadrant + 1u) & 2u) << 30);
    const int32_t other_sign = static_cast<int32_t>((quadrant & 2u) << 30);
    one[i] = radius * as_float((cosine ^ change) ^ one_sign);
    other[i] = radius * as_float((sine ^ change) ^ other_sign);
  }
}

}  // namespace pc::noise
