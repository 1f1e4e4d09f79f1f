// Normal numbers of random streams, some side by side: loops over small arrays, which compilers turn into vector code.
#pragma once

#include <cstdint>

#include "pc/math/random.hpp"

namespace pc::noise {

constexpr int kPairs = 96;  // worked on at once: three of every two points of a block

// Two normal numbers of each of the words first, first + 1, ... of a stream.
inline void normal_pairs(uint64_t key, uint64_t first, float (&one)[kPairs], float (&other)[kPairs]) {
  int32_t upper[kPairs], lower[kPairs];
  for (int i = 0; i < kPairs; ++i) {
    const uint64_t mixed = math::random_word(key, first + static_cast<uint64_t>(i));
    upper[i] = static_cast<int32_t>(mixed >> 40);
    lower[i] = static_cast<int32_t>(mixed);
  }
  for (int i = 0; i < kPairs; ++i) {
    const math::NormalPair pair = math::NormalPair::of(upper[i], lower[i]);
    one[i] = pair.one;
    other[i] = pair.other;
  }
}

}  // namespace pc::noise
