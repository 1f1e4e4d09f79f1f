// Runs of true bytes in a mask, and rows that are packed by one.
#pragma once

#include <cstdint>
#include <cstring>

#include "pc/simd.hpp"

namespace pc::rows {

struct Run {
  int64_t start, length;
};

// Write the runs of true bytes in mask[first, last) to `runs`, which has room for (last - first + 1) / 2; returns how
// many. True is any byte but 0: a mask read from a file, or a view of other bytes, may hold more than 0 and 1.
inline int64_t find_runs(const uint8_t* mask, int64_t first, int64_t last, Run* runs) {
  constexpr uint64_t kOnes = 0x0101010101010101;
  auto skip = [&](int64_t row, bool value) {  // to the first row that differs
    uint64_t word;
    for (; row + 8 <= last; row += 8) {
      std::memcpy(&word, mask + row, 8);
      if (word != value * kOnes) break;
    }
    while (row < last && (mask[row] != 0) == value) ++row;
    return row;
  };
  int64_t found = 0;
  for (int64_t row = skip(first, false); row < last;) {
    const int64_t end = skip(row, true);
    runs[found++] = {row, end - row};
    row = skip(end, false);
  }
  return found;
}

constexpr int64_t kStretch = 64;  // rows that are packed at once

// Write those of `count` rows of kWords words, up to kStretch, whose byte in the mask is true, one after another to
// packed, which has room for all of them and 16 words more; returns how many. Rows are written whether they are kept or
// not, and the next ones over them: there is no branch that chance decides.
template <int kWords>
inline int64_t pack_rows(const char* from, const uint8_t* mask, int64_t count, int32_t* packed) {
  int64_t kept = 0, row = 0;
#if defined(PC_AVX512)
  // Of 16 rows a bit each, and of all words of a row the same.
  constexpr uint64_t kFirstWords = kWords == 3 ? 0x249249249249u : kWords == 2 ? 0x55555555u : 0xFFFFu;
  static_assert(kWords >= 1 && kWords <= 3);
  for (; row + kLanes <= count; row += kLanes) {
    const __m128i bytes = _mm_loadu_si128(reinterpret_cast<const __m128i*>(mask + row));
    const uint64_t bits = _mm_test_epi8_mask(bytes, bytes);
    const uint64_t words = _pdep_u64(bits, kFirstWords) * ((uint64_t{1} << kWords) - 1);
    int32_t* to = packed + kWords * kept;
    for (int part = 0; part < kWords; ++part) {
      const auto lanes = load<Int32Register>(from + 4 * (kWords * row + kLanes * part));
      to += store_chosen(to, lanes, {static_cast<__mmask16>(words >> (kLanes * part))});
    }
    kept += __builtin_popcountll(bits);
  }
#endif
  for (; row < count; ++row) {
    std::memcpy(packed + kWords * kept, from + 4 * kWords * row, 4 * kWords);
    kept += mask[row] != 0;
  }
  return kept;
}

}  // namespace pc::rows
