// Words of random streams, and normal numbers of them: those of pcdata/rng.py and pcdata/functional/noise.py, bit for
// bit.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

// Word number `number` of the stream of a key (SplitMix64).
PC_HD uint64_t random_word(uint64_t key, uint64_t number) {
  uint64_t mixed = key + (number + 1) * 0x9E3779B97F4A7C15u;
  mixed = (mixed ^ (mixed >> 30)) * 0xBF58476D1CE4E5B9u;
  mixed = (mixed ^ (mixed >> 27)) * 0x94D049BB133111EBu;
  return mixed ^ (mixed >> 31);
}

struct NormalPair {
  float one, other;

  // Of the upper 24 bits of a word, and of its lower 32.
  PC_HD static NormalPair of(int32_t upper, int32_t lower) {
    constexpr float kStep = 1.0F / 16777216, kLog2 = 0.693147182464599609375F;
    const auto bits = static_cast<int32_t>(bits_of_float((static_cast<float>(upper) + 0.5F) * kStep));
    const int32_t exponent = (bits - 0x3F3504F3) >> 23;
    const float f = float_of_bits(static_cast<uint32_t>(bits) - (static_cast<uint32_t>(exponent) << 23)) - 1.0F;
    float log = 0.087439455F;
    log = log * f + -0.1437733F;
    log = log * f + 0.14949095F;
    log = log * f + -0.16560696F;
    log = log * f + 0.19956978F;
    log = log * f + -0.25002155F;
    log = log * f + 0.33334184F;
    log = log * f + -0.49999988F;
    log = log * f + 1.0F;
    log = log * f + static_cast<float>(exponent) * kLog2;
    const float squared = log * -2.0F;
    const float radius = sqrtf(squared > 0.0F ? squared : 0.0F);
    const int32_t fraction = (lower & 0x3FFFFFFF) >> 6;
    const float angle = (static_cast<float>(fraction) + 0.5F) * kStep - 0.5F, square = angle * angle;
    float sine = -0.004602163F;
    sine = sine * square + 0.07968022F;
    sine = sine * square + -0.6459635F;
    sine = sine * square + 1.5707964F;
    sine = sine * angle;
    float cosine = 0.0009036299F;
    cosine = cosine * square + -0.02086007F;
    cosine = cosine * square + 0.2536692F;
    cosine = cosine * square + -1.2337005F;
    cosine = cosine * square + 1.0F;
    const uint32_t quadrant = static_cast<uint32_t>(lower) >> 30, odd = 0u - (quadrant & 1u);  // all bits: they change
    const uint32_t a = bits_of_float(cosine), b = bits_of_float(sine), change = (a ^ b) & odd;
    return {radius * float_of_bits((a ^ change) ^ (((quadrant + 1u) & 2u) << 30)),
            radius * float_of_bits((b ^ change) ^ ((quadrant & 2u) << 30))};
  }
  PC_HD static NormalPair of(uint64_t word) {
    return of(static_cast<int32_t>(word >> 40), static_cast<int32_t>(word & 0xFFFFFFFFu));
  }
};

}  // namespace pc::math
