// Walking through the blocks of a field in the order of their keys, with the blocks around each at hand.
#pragma once

#include <algorithm>
#include <vector>

#include "pc/tsdf/grid.hpp"

namespace pc::tsdf {

struct SortedBlocks {
  const int64_t *keys, *rows;  // (count,) keys, rising, and the row of each
  int64_t count;
};

// The blocks of one column, (x + dx, y + dy, any z), met while walking through the keys in order: what is asked for
// only ever rises, so a cursor that moves up finds it.
class Column {
 public:
  Column(const SortedBlocks& blocks, int64_t first, int dx, int dy)
      : blocks_(blocks), step_(dx * (int64_t{1} << 42) + dy * (int64_t{1} << 21)) {
    at_ = std::lower_bound(blocks.keys, blocks.keys + blocks.count, blocks.keys[first] + step_ - 1) - blocks.keys;
  }
  // Places in the order of keys of the blocks at z - 1, z, z + 1; -1 where there is none. No key of a block is next to
  // one across a border of the grid, because the outermost numbers are not used.
  void look(int64_t key, int64_t places[3]) {
    const int64_t lowest = key + step_ - 1;
    while (at_ < blocks_.count && blocks_.keys[at_] < lowest) ++at_;
    int64_t at = at_;
    for (int i = 0; i < 3; ++i) {
      const bool found = at < blocks_.count && blocks_.keys[at] == lowest + i;
      places[i] = found ? at++ : -1;
    }
  }

 private:
  const SortedBlocks& blocks_;
  int64_t step_, at_ = 0;
};

// The 27 blocks around a block and itself, number 13: x fastest, then y, then z.
class Surroundings {
 public:
  Surroundings(const SortedBlocks& blocks, int64_t first) {
    for (int c = 0; c < 9; ++c) columns_.emplace_back(blocks, first, c % 3 - 1, c / 3 - 1);
  }
  void look(int64_t key, int64_t places[27]) {
    for (int c = 0; c < 9; ++c) {
      int64_t found[3];
      columns_[static_cast<size_t>(c)].look(key, found);
      for (int z = 0; z < 3; ++z) places[c + 9 * z] = found[z];
    }
  }

 private:
  std::vector<Column> columns_;
};

}  // namespace pc::tsdf
