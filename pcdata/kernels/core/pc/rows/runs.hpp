// Runs of true bytes in a mask.
#pragma once

#include <cstdint>
#include <cstring>

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

}  // namespace pc::rows
