// The cells around a cell, and the points in them that are near a point.
#pragma once

#include <iterator>

#include "pc/cells/cells.hpp"
#include "pc/math/distance.hpp"

namespace pc::cells {

// A row of cells as a step from the cell it is a neighbor of.
struct RowStep {
  int dx, dy;
};

// All 25 rows that hold neighbors, near first; the first is the cell's own.
constexpr RowStep kAllRows[] = {{0, 0},  {-1, 0}, {0, -1}, {0, 1},   {1, 0},   {-1, -1}, {-1, 1},  {1, -1}, {1, 1},
                                {-2, 0}, {0, -2}, {0, 2},  {2, 0},   {-2, -1}, {-2, 1},  {-1, -2}, {-1, 2}, {1, -2},
                                {1, 2},  {2, -1}, {2, 1},  {-2, -2}, {-2, 2},  {2, -2},  {2, 2}};
// Those behind the cell in sorted order, to meet every pair of cells once.
constexpr RowStep kLaterRows[] = {{0, 0},  {0, 1}, {1, 0},  {1, -1}, {1, 1},  {0, 2}, {2, 0},
                                  {1, -2}, {1, 2}, {2, -1}, {2, 1},  {2, -2}, {2, 2}};
constexpr int kAdjacentLaterRows = 5;  // of those, the rows that touch the cell's own

// Finds the neighbors of one cell after another, in rising order: a search starts where the last one for the same
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
      in_block += math::squared_distance(cells.x[i], cells.y[i], cells.z[i], q[0], q[1], q[2]) < limit;
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

}  // namespace pc::cells
