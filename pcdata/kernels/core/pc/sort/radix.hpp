// Radix sort by an integer key: stable, in parallel, the same result for any number of threads.
#pragma once

#include "pc/common.hpp"

namespace pc {

struct Range {
  int64_t begin, end;
  int64_t size() const { return end - begin; }
};

// Cut [0, count) into a few equal pieces per thread, so that a slow core does not hold the others up. Pieces too small
// for a thread of their own are not made; very large ones are cut further, for Ctrl-C.
inline std::vector<Range> even_pieces(const pc_context& context, int64_t count) {
  constexpr int64_t kSmallest = 1 << 13, kLargest = 1 << 22, kPerThread = 4;
  const int64_t wanted = std::max<int64_t>(count / kLargest, context.threads > 1 ? context.threads * kPerThread : 1);
  const int64_t pieces = std::max<int64_t>(1, std::min(wanted, count / kSmallest));
  std::vector<Range> result;
  for (int64_t p = 0; p < pieces; ++p) result.push_back({count * p / pieces, count * (p + 1) / pieces});
  return result;
}

// Bits needed to write every number below `count`.
template <class Key>
int bits_below(Key count) {
  int bits = 0;
  while (bits < static_cast<int>(8 * sizeof(Key)) && (count > (Key{1} << bits))) ++bits;
  return bits;
}

// Sort items by their `key`, of which the lowest `key_bits` matter. The items lie in `pieces` of `items`, in that order
// and perhaps with gaps; `spare` is as large. Returns whichever of the two holds the result, without gaps.
//
// Least significant digit first: each pass counts every piece's digits, then moves every item to its place.
template <class Item>
Item* radix_sort(const pc_context& context, ScratchFrame& scratch, Item* items, Item* spare, std::vector<Range> pieces,
                 int key_bits) {
  constexpr int kLargestDigit = 11;  // 2048 write streams still fit the first-level cache
  int64_t count = 0;
  for (const Range& piece : pieces) count += piece.size();
  // Few items do not pay for many counters.
  const int largest_digit = std::max(4, std::min(kLargestDigit, bits_below(static_cast<uint64_t>(count))));
  const int passes = std::max(1, (key_bits + largest_digit - 1) / largest_digit);
  const int digit = std::max(1, (key_bits + passes - 1) / passes);
  const int64_t buckets = int64_t{1} << digit;
  const std::vector<Range> even = even_pieces(context, count);
  const auto most = static_cast<int64_t>(std::max(pieces.size(), even.size()));
  uint32_t* places = scratch.take<uint32_t>(most * buckets);  // (pieces, buckets) counts, then positions

  for (int pass = 0; pass < passes; ++pass) {
    const int shift = pass * digit;
    const auto digit_of = [&](const Item& item) {
      return static_cast<size_t>(item.key >> shift) & static_cast<size_t>(buckets - 1);
    };
    const auto num_pieces = static_cast<int64_t>(pieces.size());
    parallel_for(context, num_pieces, 1, [&](int64_t p, int64_t, int64_t) {
      uint32_t* counts = places + p * buckets;
      std::fill(counts, counts + buckets, 0u);
      for (int64_t i = pieces[p].begin; i < pieces[p].end; ++i) ++counts[digit_of(items[i])];
    });
    uint32_t place = 0;
    for (int64_t bucket = 0; bucket < buckets; ++bucket)
      for (int64_t p = 0; p < num_pieces; ++p) {
        uint32_t& entry = places[p * buckets + bucket];
        const uint32_t size = entry;
        entry = place;
        place += size;
      }
    parallel_for(context, num_pieces, 1, [&](int64_t p, int64_t, int64_t) {
      uint32_t* next = places + p * buckets;
      for (int64_t i = pieces[p].begin; i < pieces[p].end; ++i) spare[next[digit_of(items[i])]++] = items[i];
    });
    std::swap(items, spare);
    pieces = even;
  }
  return items;
}

}  // namespace pc
