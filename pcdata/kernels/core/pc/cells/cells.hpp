// Cells so small that all points in one are neighbours, and the points sorted into them.
//
// A cell's side is the radius over sqrt(3), so its diagonal is just under the radius. Only occupied cells exist. A key
// numbers the cells of the cloud's bounding box row-major (x, y, z), so the cells that differ only in z, a "row", lie
// side by side when sorted, and so do their points.
#pragma once

#include <cmath>
#include <limits>

#include "pc/common.hpp"
#include "pc/math/distance.hpp"
#include "pc/sort/radix.hpp"

namespace pc {

// The diagonal stays under the radius by far more than float distances (2e-7) and cell borders (2e-5) can err.
constexpr double kCellMargin = 1e-4;
// Up to here a double cell coordinate errs by less than 2^-16 of a cell. The reference has the same limit.
constexpr double kMostCellsPerAxis = 68719476736.0;  // 2^36
// ceil(sqrt(3) * (1 + margin)): neighbours within the radius are at most two cells away on every axis.
constexpr int kReach = 2;

// Cell keys: nearly every scene fits in the first, which doubles hold exactly (a cube of 1.2 km in cells for 1 cm);
// the second holds three coordinates of 37 bits, the most there can be.
using NarrowKey = uint64_t;
__extension__ typedef unsigned __int128 WideKey;
constexpr double kNarrowKeys = 9007199254740992.0;  // 2^53

constexpr int kTile = 256;  // points taken from memory at a time; their coordinates stay in the first-level cache

inline double cell_side(float radius) { return static_cast<double>(radius) / std::sqrt(3.0) * (1 - kCellMargin); }

struct Box {
  float low[3], high[3];
};

inline void raise_to(std::atomic<double>& most, double value) {
  double seen = most.load();
  while (value > seen && !most.compare_exchange_weak(seen, value)) {
  }
}

// Call body(cloud, serial context or not) for every cloud: large ones one after another with all threads, small ones
// side by side with one thread each. `ptr` is (B+1,).
template <class Body>
void for_each_cloud(const pc_context& context, const int64_t* ptr, int64_t clouds, Body&& body) {
  constexpr int64_t kLarge = 1 << 15;  // below this, threads cost more than they give
  std::vector<int64_t> small;
  for (int64_t cloud = 0; cloud < clouds; ++cloud) {
    const int64_t count = ptr[cloud + 1] - ptr[cloud];
    if (count > std::numeric_limits<uint32_t>::max()) throw std::bad_alloc();  // it would need 400 GB
    if (count >= kLarge)
      body(context, ptr[cloud], count);
    else if (count > 0)
      small.push_back(cloud);
  }
  const pc_context alone{1, nullptr};
  parallel_for(context, static_cast<int64_t>(small.size()), 4, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t i = begin; i < end; ++i) body(alone, ptr[small[i]], ptr[small[i] + 1] - ptr[small[i]]);
  });
}

// Bounds of (count, 3) points. The lanes hold whole points, so they compile to vector minima without a shuffle.
inline Box bounds_of(const float* points, int64_t count) {
  constexpr int kLanes = 48;  // a multiple of 3 and of every vector width
  float low[kLanes], high[kLanes];
  for (int l = 0; l < kLanes; ++l) low[l] = high[l] = points[l % 3];
  int64_t i = 0;
  for (; i + kLanes <= 3 * count; i += kLanes)
    for (int l = 0; l < kLanes; ++l) {
      low[l] = points[i + l] < low[l] ? points[i + l] : low[l];
      high[l] = points[i + l] > high[l] ? points[i + l] : high[l];
    }
  for (int l = 0; i + l < 3 * count; ++l) {
    low[l] = std::min(low[l], points[i + l]);
    high[l] = std::max(high[l], points[i + l]);
  }
  Box box;
  for (int axis = 0; axis < 3; ++axis) {
    box.low[axis] = low[axis];
    box.high[axis] = high[axis];
    for (int l = axis; l < kLanes; l += 3) {
      box.low[axis] = std::min(box.low[axis], low[l]);
      box.high[axis] = std::max(box.high[axis], high[l]);
    }
  }
  return box;
}

inline Box hull(const std::vector<Box>& boxes) {
  Box all = boxes.front();
  for (const Box& box : boxes)
    for (int axis = 0; axis < 3; ++axis) {
      all.low[axis] = std::min(all.low[axis], box.low[axis]);
      all.high[axis] = std::max(all.high[axis], box.high[axis]);
    }
  return all;
}

inline Box parallel_bounds(const pc_context& context, const float* points, int64_t count) {
  const std::vector<Range> pieces = even_pieces(context, count);
  std::vector<Box> boxes(pieces.size());
  parallel_for(context, static_cast<int64_t>(pieces.size()), 1, [&](int64_t p, int64_t, int64_t) {
    boxes[p] = bounds_of(points + 3 * pieces[p].begin, pieces[p].size());
  });
  return hull(boxes);
}

// The largest cell coordinate in the box, computed as the reference computes it.
inline double largest_coordinate(const Box& box, double side) {
  double largest = 0;
  for (int axis = 0; axis < 3; ++axis)
    largest = std::max(largest, (static_cast<double>(box.high[axis]) - static_cast<double>(box.low[axis])) / side);
  return largest;
}

// Where the cells of a cloud lie and how they are numbered.
struct Lattice {
  double low[3];
  double per_length;
  double span[3];  // cells along each axis, with room of kReach at both ends: a neighbour's key never wraps

  Lattice(const Box& box, double side) : per_length(1.0 / side) {
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = static_cast<double>(box.low[axis]);
      span[axis] = std::floor((static_cast<double>(box.high[axis]) - low[axis]) * per_length) + 1 + 2 * kReach;
    }
  }
  bool fits_narrow() const {
    constexpr double kMostPerAxis = 1 << 30;
    return span[0] < kMostPerAxis && span[1] < kMostPerAxis && span[2] < kMostPerAxis &&
           span[0] * span[1] * span[2] < kNarrowKeys;
  }
  template <class Key>
  Key row_step(int dx, int dy) const {  // from a key to the key of the cell (dx, dy, 0) away, modulo the key's range
    const Key dx_rows = static_cast<Key>(span[1]) * static_cast<Key>(dx) + static_cast<Key>(dy);
    return dx_rows * static_cast<Key>(span[2]);
  }
  template <class Key>
  int key_bits() const {
    return bits_below<Key>(static_cast<Key>(span[0]) * static_cast<Key>(span[1]) * static_cast<Key>(span[2]));
  }
};

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

// Consecutive points of one cell: neighbouring pixels mostly share a cell, so depth images sort runs, not points.
template <class Key>
struct Run {
  Key key;
  uint32_t first, count;
};

template <class Key>
int64_t write_runs(const Lattice& lattice, const float* points, const uint32_t* rows, Range piece, Run<Key>* runs) {
  Tile tile;
  alignas(64) Key keys[kTile];
  Run<Key>* last = runs - 1;
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
  Run<Key>* runs = scratch.take<Run<Key>>(count);
  Run<Key>* spare = scratch.take<Run<Key>>(count);
  std::vector<Range> pieces = even_pieces(context, count);
  parallel_for(context, static_cast<int64_t>(pieces.size()), 1, [&](int64_t p, int64_t, int64_t) {
    Range& piece = pieces[p];
    piece.end = piece.begin + write_runs(lattice, points, rows, piece, runs + piece.begin);
  });
  runs = radix_sort(context, scratch, runs, spare, pieces, lattice.key_bits<Key>());

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
  Cells<Key> cells{lattice, num_cells, key, start, count, scratch.take<float>(count), scratch.take<float>(count),
                   scratch.take<float>(count), scratch.take<uint32_t>(count)};
  constexpr int64_t kAhead = 16;  // points in no order are fetched this early, or each would wait for memory
  parallel_for(context, num_pieces, 1, [&](int64_t p, int64_t, int64_t) {
    int64_t cell = cells_before[p], place = points_before[p];
    for (int64_t r = pieces[p].begin; r < pieces[p].end; ++r) {
      if (rows == nullptr && r + kAhead < num_runs) __builtin_prefetch(points + 3 * int64_t{runs[r + kAhead].first});
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

// Call body(cell, begin, end) for every cell that owns some of the points [begin, end), with the part it owns: pieces of
// points are even work, however unlike the cells are.
template <class Key, class Body>
void for_each_cell(const Cells<Key>& cells, int64_t begin, int64_t end, Body&& body) {
  const uint32_t* after = std::upper_bound(cells.start, cells.start + cells.count, static_cast<uint32_t>(begin));
  for (int64_t cell = after - cells.start - 1; begin < end; ++cell) {
    const int64_t stop = std::min<int64_t>(end, cells.start[cell + 1]);
    body(cell, begin, stop);
    begin = stop;
  }
}

// A row of cells as a step from the cell it is a neighbour of.
struct RowStep {
  int dx, dy;
};

// All 25 rows that hold neighbours, near first; the first is the cell's own.
constexpr RowStep kAllRows[] = {{0, 0},  {-1, 0}, {0, -1}, {0, 1},  {1, 0},  {-1, -1}, {-1, 1}, {1, -1}, {1, 1},
                                {-2, 0}, {0, -2}, {0, 2},  {2, 0},  {-2, -1}, {-2, 1}, {-1, -2}, {-1, 2}, {1, -2},
                                {1, 2},  {2, -1}, {2, 1},  {-2, -2}, {-2, 2}, {2, -2}, {2, 2}};
// Those behind the cell in sorted order, to meet every pair of cells once.
constexpr RowStep kLaterRows[] = {{0, 0}, {0, 1},  {1, 0},  {1, -1}, {1, 1}, {0, 2}, {2, 0},
                                  {1, -2}, {1, 2}, {2, -1}, {2, 1}, {2, -2}, {2, 2}};
constexpr int kAdjacentLaterRows = 5;  // of those, the rows that touch the cell's own

// Finds the neighbours of one cell after another, in rising order: a search starts where the last one for the same
// step ended, so a sweep over all cells reads every row about once. Nothing is looked up before it is asked for.
template <class Key>
class Neighborhood {
 public:
  template <int kRows>
  Neighborhood(const Cells<Key>& cells, const RowStep (&steps)[kRows], int reach = kReach)
      : cells_(cells), reach_(reach) {
    static_assert(kRows <= kMostRows);
    for (int i = 0; i < kRows; ++i) {
      step_[i] = cells.lattice.template row_step<Key>(steps[i].dx, steps[i].dy);
      hint_[i] = 0;
    }
  }

  void move_to(int64_t cell) {
    key_ = cells_.key[cell];
    known_ = 0;
  }

  // The cells of row i within reach along z; rows are asked for in order 0, 1, 2, ..., again as often as one likes.
  Range row(int i) {
    for (; known_ <= i; ++known_) find(known_);
    return found_[i];
  }
  // The points of row i.
  Range points(int i) {
    const Range cells = row(i);
    return {cells_.start[cells.begin], cells_.start[cells.end]};
  }

 private:
  static constexpr int kMostRows = 25;

  void find(int i) {
    const Key middle = key_ + step_[i];
    const int64_t first = seek(hint_[i], middle - static_cast<Key>(reach_));
    int64_t end = first;
    while (end < cells_.count && cells_.key[end] <= middle + static_cast<Key>(reach_)) ++end;
    hint_[i] = first;
    found_[i] = {first, end};
  }

  // The first cell at or after `from` whose key is not below `wanted`: steps of 1, 2, 4, ..., then bisection.
  int64_t seek(int64_t from, Key wanted) const {
    int64_t step = 1, end = from;
    while (end < cells_.count && cells_.key[end] < wanted) {
      from = end + 1;
      end += step;
      step *= 2;
    }
    return std::lower_bound(cells_.key + from, cells_.key + std::min(end, cells_.count), wanted) - cells_.key;
  }

  const Cells<Key>& cells_;
  const int reach_;
  Key key_{};
  int known_ = 0;
  Key step_[kMostRows];
  int64_t hint_[kMostRows];
  Range found_[kMostRows];
};

// How many of the points [range) are nearer to q than sqrt(limit); may stop once there are `enough`.
template <class Key>
int64_t count_near(const Cells<Key>& cells, Range range, const float* q, float limit, int64_t enough) {
  constexpr int64_t kBlock = 64;
  int64_t near = 0;
  for (int64_t begin = range.begin; begin < range.end && near < enough; begin += kBlock) {
    const int64_t end = std::min(range.end, begin + kBlock);
    int32_t in_block = 0;
    for (int64_t i = begin; i < end; ++i)
      in_block += squared_distance(cells.x[i], cells.y[i], cells.z[i], q[0], q[1], q[2]) < limit;
    near += in_block;
  }
  return near;
}

// Whether at least `enough` points lie near sorted point `i` of `cell`, whose own cell counts whole.
template <class Key>
bool has_near(const Cells<Key>& cells, Neighborhood<Key>& around, int64_t cell, int64_t i, float limit,
              int64_t enough) {
  const float q[3] = {cells.x[i], cells.y[i], cells.z[i]};
  int64_t near = cells.size(cell);
  const Range own = around.points(0);
  near += count_near(cells, {own.begin, cells.start[cell]}, q, limit, enough - near);
  near += count_near(cells, {cells.start[cell + 1], own.end}, q, limit, enough - near);
  for (int r = 1; r < static_cast<int>(std::size(kAllRows)) && near < enough; ++r)
    near += count_near(cells, around.points(r), q, limit, enough - near);
  return near >= enough;
}

}  // namespace pc
