// Sorting by integer keys: stable, in parallel, the same result for any number of threads.
#pragma once

#include <utility>

#include "pc/memory.hpp"
#include "pc/threads.hpp"

namespace pc::sort {

// Bits needed to write every number below `count`.
template <class Key>
int bits_below(Key count) {
  int bits = 0;
  while (bits < static_cast<int>(8 * sizeof(Key)) && (count > (Key{1} << bits))) ++bits;
  return bits;
}

// The pass that every sort here is made of: move items into buckets, in their order within each. The items lie in
// `pieces`, in that order and perhaps with gaps; they go to `to` without.
//
// `prepare(piece)` is called once for each before it is counted; bucket_of(i) and item(i) tell about item i. `places`
// (pieces, buckets) is working space. Returns how many items there are; starts (buckets,) become the first of each
// bucket, and may be null.
template <class Item, class Prepare, class BucketOf, class Read>
uint32_t counting_pass(const pc_context& context, const std::vector<Range>& pieces, int64_t buckets, uint32_t* places,
                       const Prepare& prepare, const BucketOf& bucket_of, const Read& item, Item* to,
                       uint32_t* starts = nullptr) {
  const auto num_pieces = static_cast<int64_t>(pieces.size());
  parallel_for(context, num_pieces, 1, [&](int64_t p, int64_t, int64_t) {
    const Range piece = pieces[static_cast<size_t>(p)];
    prepare(piece);
    uint32_t* counts = places + p * buckets;
    std::fill(counts, counts + buckets, 0u);
    for (int64_t i = piece.begin; i < piece.end; ++i) ++counts[bucket_of(i)];
  });
  uint32_t place = 0;
  for (int64_t bucket = 0; bucket < buckets; ++bucket) {
    if (starts != nullptr) starts[bucket] = place;
    for (int64_t p = 0; p < num_pieces; ++p) place += std::exchange(places[p * buckets + bucket], place);
  }
  parallel_for(context, num_pieces, 1, [&](int64_t p, int64_t, int64_t) {
    const Range piece = pieces[static_cast<size_t>(p)];
    uint32_t* next = places + p * buckets;
    for (int64_t i = piece.begin; i < piece.end; ++i) to[next[bucket_of(i)]++] = item(i);
  });
  return place;
}

// Sort items by their `key`, of which the lowest `key_bits` matter. The items lie in `pieces` of `items`, in that order
// and perhaps with gaps; `spare` is as large. Returns whichever of the two holds the result, without gaps.
//
// Least significant digit first.
template <class Item>
Item* radix_sort(const pc_context& context, ScratchFrame& scratch, Item* items, Item* spare, std::vector<Range> pieces,
                 int key_bits) {
  constexpr int kLargestDigit = 11;  // 2048 write streams still fit the first-level cache
  int64_t count = 0;
  for (const Range& piece : pieces) count += piece.size();
  require_numbered(count);
  // Few items do not pay for many counters.
  const int largest_digit = std::max(4, std::min(kLargestDigit, bits_below(static_cast<uint64_t>(count))));
  const int passes = std::max(1, (key_bits + largest_digit - 1) / largest_digit);
  const int digit = std::max(1, (key_bits + passes - 1) / passes);
  const int64_t buckets = int64_t{1} << digit;
  const std::vector<Range> even = even_pieces(context, count);
  const auto most = static_cast<int64_t>(std::max(pieces.size(), even.size()));
  uint32_t* places = scratch.take<uint32_t>(most * buckets);
  for (int pass = 0; pass < passes; ++pass) {
    const int shift = pass * digit;
    const auto mask = static_cast<size_t>(buckets - 1);
    const Item* from = items;
    counting_pass(
        context, pieces, buckets, places, [](Range) {},
        [from, shift, mask](int64_t i) { return static_cast<size_t>(from[i].key >> shift) & mask; },
        [from](int64_t i) { return from[i]; }, spare);
    std::swap(items, spare);
    pieces = even;
  }
  return items;
}

}  // namespace pc::sort
