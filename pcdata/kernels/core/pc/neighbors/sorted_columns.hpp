// Sixteen ascending lists side by side, a column of an array each: sorting them, and what is least of two.
#pragma once

#include "pc/neighbors/nearest.hpp"

namespace pc::neighbors {

// One number of each list is a row; lists are whole blocks of eight rows.
using Row = float[kQueries];
constexpr int kBlockRows = 8;
constexpr int kMostBlocks = 6;

// The exchanges of a network that sorts `kCount` numbers, or merges a run that rises and then falls.
template <int kMost>
struct Exchanges {
  int count = 0;
  uint8_t low[kMost] = {}, high[kMost] = {};

  constexpr void add(int i, int j) {
    low[count] = static_cast<uint8_t>(i);
    high[count] = static_cast<uint8_t>(j);
    ++count;
  }
};

constexpr int power_of_two_from(int count) {
  int power = 1;
  while (power < count) power *= 2;
  return power;
}

// Merge exchange (Batcher 1968; Knuth, TAOCP volume 3, section 5.2.2, algorithm M).
template <int kCount>
constexpr Exchanges<512> sorting_exchanges() {
  Exchanges<512> network;
  constexpr int kTop = power_of_two_from(kCount) / 2;
  for (int p = kTop; p > 0; p /= 2)
    for (int q = kTop, r = 0, d = p;; d = q - p, q /= 2, r = p) {
      for (int i = 0; i + d < kCount; ++i)
        if ((i & p) == r) network.add(i, i + d);
      if (q == p) break;
    }
  return network;
}

// Batcher's network for numbers that rise and then fall. For a count that is no power of two it is that of the next
// power with numbers below all others in front, which rise into the rest and stay where they are.
template <int kCount>
constexpr Exchanges<512> merging_exchanges() {
  Exchanges<512> network;
  constexpr int kAll = power_of_two_from(kCount), kBefore = kAll - kCount;
  for (int step = kAll / 2; step > 0; step /= 2)
    for (int i = kBefore; i + step < kAll; ++i)
      if ((i & step) == 0) network.add(i - kBefore, i + step - kBefore);
  return network;
}

enum class Network { kSorting, kMerging };

template <Network kKind, int kCount>
struct NetworkOf {
  static constexpr Exchanges<512> kExchanges =
      kKind == Network::kSorting ? sorting_exchanges<kCount>() : merging_exchanges<kCount>();

  // GCC keeps an array in registers only when its indices are constants from the start: hence the folds.
  [[gnu::always_inline]] static void exchange(FloatRegister (&v)[kCount]) {
    exchange(v, std::make_index_sequence<static_cast<size_t>(kExchanges.count)>());
  }
  template <size_t... E>
  [[gnu::always_inline]] static void exchange(FloatRegister (&v)[kCount], std::index_sequence<E...>) {
    (exchange_two<kExchanges.low[E], kExchanges.high[E]>(v), ...);
  }
  template <size_t kLow, size_t kHigh>
  [[gnu::always_inline]] static void exchange_two(FloatRegister (&v)[kCount]) {
    put_in_order(v[kLow], v[kHigh]);
  }
  template <size_t... I>
  [[gnu::always_inline]] static void run_lanes(Row* rows, int lane, std::index_sequence<I...>) {
    FloatRegister v[kCount] = {load<FloatRegister>(rows[I] + lane)...};
    exchange(v);
    (store(rows[I] + lane, v[I]), ...);
  }
  // On its own, lest GCC runs out of registers where it is called from.
  [[gnu::noinline]] static void run(Row* rows) {
    for (int lane = 0; lane < kQueries; lane += kLanes) run_lanes(rows, lane, std::make_index_sequence<kCount>());
  }
};

// Sort every column of so many blocks.
inline void sort_columns(Row* rows, int blocks) {
  switch (blocks) {
    case 1:
      return NetworkOf<Network::kSorting, 1 * kBlockRows>::run(rows);
    case 2:
      return NetworkOf<Network::kSorting, 2 * kBlockRows>::run(rows);
    case 3:
      return NetworkOf<Network::kSorting, 3 * kBlockRows>::run(rows);
    case 4:
      return NetworkOf<Network::kSorting, 4 * kBlockRows>::run(rows);
    case 5:
      return NetworkOf<Network::kSorting, 5 * kBlockRows>::run(rows);
    default:
      return NetworkOf<Network::kSorting, 6 * kBlockRows>::run(rows);
  }
}

}  // namespace pc::neighbors
