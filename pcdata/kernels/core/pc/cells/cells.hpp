// The points of a cloud sorted into the cells of its lattice.
#pragma once

#include "pc/cells/lattice.hpp"
#include "pc/memory.hpp"

namespace pc::cells {

constexpr int kTile = 256;  // points taken from memory at a time; their coordinates stay in the first-level cache

// Up to kTile points with each coordinate in an array of its own.
struct Tile {
  alignas(64) float x[kTile], y[kTile], z[kTile];

  // Points begin, begin + 1, ... or, with rows given, points rows[begin], rows[begin + 1], ...
  void load(const float* points, const uint32_t* rows, int64_t begin, int count) {
    if (rows == nullptr) {
      const float* first = points + 3 * begin;
      for (int i = 0; i < count; ++i) {
        x[i] = first[3 * i];
        y[i] = first[3 * i + 1];
        z[i] = first[3 * i + 2];
      }
      return;
    }
    for (int i = 0; i < count; ++i) {
      const float* point = points + 3 * static_cast<int64_t>(rows[begin + i]);
      x[i] = point[0];
      y[i] = point[1];
      z[i] = point[2];
    }
  }
};

inline void tile_keys(const Lattice& lattice, const Tile& tile, int count, NarrowKey* keys) {
  const double step_y = lattice.span[2], step_x = lattice.span[1] * step_y;
  const double first = kReach * (step_x + step_y + 1);
  const auto cell = [&](float value, int axis) {  // through int32: rounds down in vectors on every processor
    return static_cast<double>(
        static_cast<int32_t>((static_cast<double>(value) - lattice.low[axis]) * lattice.per_length));
  };
  for (int i = 0; i < count; ++i) {
    const double key = first + cell(tile.x[i], 0) * step_x + cell(tile.y[i], 1) * step_y + cell(tile.z[i], 2);
    keys[i] = static_cast<NarrowKey>(static_cast<int64_t>(key));
  }
}

inline void tile_keys(const Lattice& lattice, const Tile& tile, int count, WideKey* keys) {
  const auto cell = [&](float value, int axis) {
    return static_cast<WideKey>(
        static_cast<int64_t>((static_cast<double>(value) - lattice.low[axis]) * lattice.per_length) + kReach);
  };
  for (int i = 0; i < count; ++i)
    keys[i] = (cell(tile.x[i], 0) * static_cast<WideKey>(lattice.span[1]) + cell(tile.y[i], 1)) *
                  static_cast<WideKey>(lattice.span[2]) +
              cell(tile.z[i], 2);
}

// The points of a cloud, cell after cell.
template <class Key>
struct Cells {
  Lattice lattice;
  int64_t count;          // C
  const Key* key;         // (C,) rising
  const uint32_t* start;  // (C + 1,) first point of each cell
  int64_t num_points;     // n
  float *x, *y, *z;       // (n,)
  uint32_t* row;          // (n,) where each point stands in the cloud

  int64_t size(int64_t cell) const { return start[cell + 1] - start[cell]; }
};

// Consecutive points of one cell: neighboring pixels mostly share a cell, so depth images sort runs, not points.
template <class Key>
struct CellRun {
  Key key;
  uint32_t first, count;
};

template <class Key>
int64_t write_runs(const Lattice& lattice, const float* points, const uint32_t* rows, Range piece, CellRun<Key>* runs) {
  Tile tile;
  alignas(64) Key keys[kTile];
  CellRun<Key>* last = runs - 1;
  for (int64_t begin = piece.begin; begin < piece.end; begin += kTile) {
    const int count = static_cast<int>(std::min<int64_t>(kTile, piece.end - begin));
    tile.load(points, rows, begin, count);
    tile_keys(lattice, tile, count, keys);
    for (int i = 0; i < count; ++i) {
      if (last >= runs && last->key == keys[i])
        ++last->count;
      else
        *++last = {keys[i], static_cast<uint32_t>(begin + i), 1};
    }
  }
  return last + 1 - runs;
}

// Sort a cloud's points into cells; `rows` (count,) picks some of them, null = points 0, 1, ..., count - 1.
template <class Key>
Cells<Key> sort_into_cells(const pc_context& context, ScratchFrame& scratch, const Lattice& lattice,
                           const float* points, const uint32_t* rows, int64_t count) {
  CellRun<Key>* runs = scratch.take<CellRun<Key>>(count);
  CellRun<Key>* spare = scratch.take<CellRun<Key>>(count);
  std::vector<Range> pieces = even_pieces(context, count);
  parallel_for(context, static_cast<int64_t>(pieces.size()), 1, [&](int64_t p, int64_t, int64_t) {
    Range& piece = pieces[p];
    piece.end = piece.begin + write_runs(lattice, points, rows, piece, runs + piece.begin);
  });
  runs = sort::radix_sort(context, scratch, runs, spare, pieces, lattice.key_bits<Key>());

  int64_t num_runs = 0;
  for (const Range& piece : pieces) num_runs += piece.size();
  const auto opens_cell = [&](int64_t r) { return r == 0 || runs[r].key != runs[r - 1].key; };
  pieces = even_pieces(context, num_runs);
  const auto num_pieces = static_cast<int64_t>(pieces.size());
  std::vector<int64_t> cells_before(pieces.size() + 1), points_before(pieces.size() + 1);
  parallel_for(context, num_pieces, 1, [&](int64_t p, int64_t, int64_t) {
    for (int64_t r = pieces[p].begin; r < pieces[p].end; ++r) {
      cells_before[p + 1] += opens_cell(r);
      points_before[p + 1] += runs[r].count;
    }
  });
  for (int64_t p = 0; p < num_pieces; ++p) {
    cells_before[p + 1] += cells_before[p];
    points_before[p + 1] += points_before[p];
  }

  const int64_t num_cells = cells_before.back();
  Key* key = scratch.take<Key>(num_cells);
  uint32_t* start = scratch.take<uint32_t>(num_cells + 1);
  Cells<Key> cells{lattice,
                   num_cells,
                   key,
                   start,
                   count,
                   scratch.take<float>(count),
                   scratch.take<float>(count),
                   scratch.take<float>(count),
                   scratch.take<uint32_t>(count)};
  constexpr int64_t kAhead = 16;  // points in no order are fetched this early, or each would wait for memory
  parallel_for(context, num_pieces, 1, [&](int64_t p, int64_t, int64_t) {
    int64_t cell = cells_before[p], place = points_before[p];
    for (int64_t r = pieces[p].begin; r < pieces[p].end; ++r) {
      if (r + kAhead < num_runs) {
        const uint32_t next = runs[r + kAhead].first;
        __builtin_prefetch(points + 3 * int64_t{rows == nullptr ? next : rows[next]});
      }
      if (opens_cell(r)) {
        key[cell] = runs[r].key;
        start[cell++] = static_cast<uint32_t>(place);
      }
      for (uint32_t i = runs[r].first; i < runs[r].first + runs[r].count; ++i, ++place) {
        const uint32_t row = rows == nullptr ? i : rows[i];
        const float* point = points + 3 * static_cast<int64_t>(row);
        cells.x[place] = point[0];
        cells.y[place] = point[1];
        cells.z[place] = point[2];
        cells.row[place] = row;
      }
    }
  });
  start[num_cells] = static_cast<uint32_t>(count);
  return cells;
}

// Call body(cell, begin, end) for every cell that owns some of the points [begin, end), with the part it owns: pieces
// of points are even work, however unlike the cells are.
template <class Key, class Body>
void for_each_cell(const Cells<Key>& cells, int64_t begin, int64_t end, Body&& body) {
  const uint32_t* after = std::upper_bound(cells.start, cells.start + cells.count, static_cast<uint32_t>(begin));
  for (int64_t cell = after - cells.start - 1; begin < end; ++cell) {
    const int64_t stop = std::min<int64_t>(end, cells.start[cell + 1]);
    body(cell, begin, stop);
    begin = stop;
  }
}

}  // namespace pc::cells
