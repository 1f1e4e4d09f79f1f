// How many points lie in each cell, without sorting them: points in no order are expensive to move.
#pragma once

#include <atomic>

#include "pc/cells/cells.hpp"

namespace pc::cells {

// The points of some cells, in a hash table. An entry is a key above the number of points, which ends at kMost.
class CellCounts {
 public:
  static constexpr uint64_t kMost = 255;

  // Room for so many cells.
  CellCounts(ScratchFrame& scratch, int64_t cells)
      : bits_(std::clamp(sort::bits_below<uint64_t>(static_cast<uint64_t>(cells) * 3 / 2), 8, 40)),
        left_(cells),
        entries_(scratch.take<uint64_t>(int64_t{1} << bits_)) {}

  void clear() { std::fill(entries_, entries_ + (int64_t{1} << bits_), uint64_t{0}); }

  void prefetch(NarrowKey key) const { __builtin_prefetch(entries_ + first_place(key), 1); }
  bool has_room() const { return left_ >= 0; }

  // Count a point, while there is room; returns how many points its cell has so far.
  uint64_t add(NarrowKey key) {
    const size_t at = place(key);
    uint64_t entry = entries_[at];
    if (entry == 0) {
      --left_;
      entry = key << 8;
    }
    entry += (entry & kMost) < kMost;
    entries_[at] = entry;
    return entry & kMost;
  }
  uint64_t count(NarrowKey key) const { return entries_[place(key)] & kMost; }

 private:
  // Where a cell is looked for first. Eight cells along z share a line of the processor's cache.
  size_t first_place(NarrowKey key) const {
    return ((key >> 3) * 0x9E3779B97F4A7C15u >> (64 - (bits_ - 3))) << 3 | (key & 7);
  }
  // Where it is, or would be.
  size_t place(NarrowKey key) const {
    const size_t mask = (size_t{1} << bits_) - 1;
    size_t at = first_place(key);
    while (entries_[at] != 0 && entries_[at] >> 8 != key) at = (at + 1) & mask;  // no key is 0: see Lattice
    return at;
  }

  int bits_;
  int64_t left_;
  uint64_t* entries_;
};

// Clear the mark of points in cells that hold `enough` points or more, of those `within`, if not null; returns how many
// points stay marked.
//
// Gives up where cells hold fewer than twice as many on average: then nobody knows how many stay, and all may.
inline int64_t clear_crowded(const pc_context& context, const Lattice& lattice, const float* points,
                             const uint8_t* within, int64_t count, int64_t enough, uint8_t* marks) {
  constexpr int64_t kMostTables = 8;
  const auto wanted = static_cast<uint64_t>(enough);
  if (wanted > CellCounts::kMost || !lattice.fits_narrow()) return count;
  struct Waiting {
    NarrowKey key;
    uint32_t row;
  };
  ScratchFrame scratch;
  const int64_t stretches = std::min<int64_t>(context.threads, kMostTables), most_cells = count / (2 * enough);
  std::vector<CellCounts> tables;
  for (int64_t s = 0; s < stretches; ++s) tables.emplace_back(scratch, most_cells);
  Waiting* waiting = scratch.take<Waiting>(count);
  std::vector<Range> kept(static_cast<size_t>(stretches));
  std::atomic<bool> full{false};
  // A cell is known to be crowded once enough of its points were met: only those before them wait for the end.
  parallel_for(context, stretches, 1, [&](int64_t s, int64_t, int64_t) {
    CellCounts table = tables[static_cast<size_t>(s)];
    table.clear();
    Tile tile;
    alignas(64) NarrowKey keys[kTile];
    const int64_t first = count * s / stretches, end = count * (s + 1) / stretches;
    int64_t last = first;
    for (int64_t begin = first; begin < end; begin += kTile) {
      const int number = static_cast<int>(std::min<int64_t>(kTile, end - begin));
      tile.load(points, nullptr, begin, number);
      tile_keys(lattice, tile, number, keys);
      for (int i = 0; i < number; ++i) table.prefetch(keys[i]);
      for (int i = 0; i < number; ++i) {
        if (within != nullptr && !within[begin + i]) continue;
        waiting[last] = {keys[i], static_cast<uint32_t>(begin + i)};
        const bool waits = table.add(keys[i]) < wanted;
        marks[begin + i] &= waits;
        last += waits;
      }
      if (!table.has_room()) full = true;
      if (full) return;
    }
    kept[static_cast<size_t>(s)] = {first, last};
  });
  if (full) return count;
  std::atomic<int64_t> left{0};
  parallel_for(context, stretches, 1, [&](int64_t s, int64_t, int64_t) {
    int64_t own = 0;
    for (int64_t i = kept[static_cast<size_t>(s)].begin; i < kept[static_cast<size_t>(s)].end; ++i) {
      const auto [key, row] = waiting[i];
      uint64_t in_cell = 0;
      for (const CellCounts& table : tables) in_cell += table.count(key);
      marks[row] &= in_cell < wanted;
      own += marks[row];
    }
    left += own;
  });
  return left;
}

}  // namespace pc::cells
