// The cells of a plane in which a surface lies: where points near it are no rarer than usual, in large patches.
#pragma once

#include <tuple>
#include <vector>

#include "pc/memory.hpp"
#include "pc/planes/flat_cells.hpp"
#include "pc/threads.hpp"

namespace pc::planes {

// Leave out the patches of marked cells, connected over corners too, that are small beside the largest. No cell at a
// rim is marked.
inline void keep_large(uint8_t* cells, int64_t count, int64_t width, int64_t smaller) {
  const int64_t around[8] = {-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1};
  std::vector<int64_t> members, ends;
  for (int64_t first = 0; first < count; ++first) {
    if (cells[first] != 1) continue;
    cells[first] = 2;
    members.push_back(first);
    for (size_t next = members.size() - 1; next < members.size(); ++next) {
      for (const int64_t step : around) {
        const int64_t other = members[next] + step;
        if (cells[other] != 1) continue;
        cells[other] = 2;
        members.push_back(other);
      }
    }
    ends.push_back(static_cast<int64_t>(members.size()));
  }
  int64_t largest = 0, begin = 0;
  for (const int64_t end : ends) largest = std::max(largest, end - begin), begin = end;
  begin = 0;
  for (const int64_t end : ends) {
    for (int64_t i = begin; i < end; ++i)
      cells[members[static_cast<size_t>(i)]] = (end - begin) * smaller >= largest ? 1 : 0;
    begin = end;
  }
}

// As the reference describes them, found on some of the points.
class PatchCells {
 public:
  PatchCells(const pc_context& context, const float* points, const uint8_t* near, int64_t count, const Plane& plane,
             const PlaneAxes& axes, double distance, ScratchFrame& scratch)
      : context_(context), stride_(std::max<int64_t>(1, count / kMostPoints)) {
    look(points, near, count, plane, axes, static_cast<float>(kReach * distance), scratch);
    if (num_near_ == 0) return;
    double spans[2];
    for (int axis = 0; axis < 2; ++axis) spans[axis] = static_cast<double>(high_[axis] - low_[axis]);
    const double span = std::max(spans[0], spans[1]);
    double edge = std::max(kCell * distance, span / kMostCells);
    is_too_far_ = !(std::isfinite(spans[0]) && std::isfinite(spans[1]) && std::isfinite(static_cast<float>(1 / edge)));
    if (is_too_far_) return;
    count_in_cells(spans, edge);
    while (is_sparse() && !(edge > span / 4)) {
      edge *= 2;
      count_in_cells(spans, edge);
    }
    marked_ = scratch.take<uint8_t>(cells_.size());
    mark_usual();
    keep_large(marked_, cells_.size(), cells_.columns.count, kSmaller);
    add_rim();
  }

  // False where no point that was looked at is near the plane.
  bool are_any() const { return num_near_ > 0; }
  // True where places are too far away to be numbered.
  bool is_too_far() const { return is_too_far_; }

  const FlatCells& cells() const { return cells_; }
  const uint8_t* marked() const { return marked_; }

 private:
  static constexpr int64_t kMostPoints = 1 << 14, kCrossed = 2, kSmaller = 10;
  static constexpr int kShareBits = 30;
  static constexpr double kReach = 5, kCell = 4, kMostLonely = 0.2, kMostCells = 500;
  static constexpr int64_t kPiece = 1 << 13;  // points that one thread looks at
  static constexpr int64_t kRoom = kPiece + kLanes;
  static constexpr uint64_t kNear = uint64_t{1} << 32;  // counts of points near the plane are above those of all

  // Places in the plane of some of the points: of those near it, and of those that tell whether something crosses.
  struct Piece {
    int64_t count = 0, num_near = 0;
    float low[2], high[2];
  };

  void look(const float* points, const uint8_t* near, int64_t count, const Plane& plane, const PlaneAxes& axes,
            float reach, ScratchFrame& scratch) {
    const int64_t some = (count + stride_ - 1) / stride_, num_pieces = (some + kPiece - 1) / kPiece;
    down_ = scratch.take<float>(num_pieces * kRoom);
    right_ = scratch.take<float>(num_pieces * kRoom);
    near_ = scratch.take<uint8_t>(num_pieces * kRoom);
    cell_ = scratch.take<int32_t>(num_pieces * kRoom);
    pieces_.resize(static_cast<size_t>(num_pieces));
    const Axis down(axes.down), right(axes.right);
    parallel_for(context_, num_pieces, 1, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t piece = first; piece < last; ++piece) {
        Piece& own = pieces_[static_cast<size_t>(piece)];
        float *to_down = down_ + piece * kRoom, *to_right = right_ + piece * kRoom;
        uint8_t* to_near = near_ + piece * kRoom;
        int64_t found = 0;
        for (int64_t i = piece * kPiece; i < std::min(some, (piece + 1) * kPiece); ++i) {
          const float* p = points + 3 * stride_ * i;
          const uint8_t is_near = near[stride_ * i];
          to_down[found] = down.along(p);
          to_right[found] = right.along(p);
          to_near[found] = is_near;
          own.num_near += is_near;
          found += static_cast<int64_t>((is_near != 0) | plane.is_near(p, reach));
        }
        own.count = found;
        for (int64_t i = found; i < found + kLanes; ++i) to_down[i] = to_right[i] = 0;
        if (found == 0) continue;
        std::tie(own.low[0], own.high[0]) = bounds(to_down, found);
        std::tie(own.low[1], own.high[1]) = bounds(to_right, found);
      }
    });
    for (const Piece& own : pieces_) {
      num_near_ += own.num_near;
      if (own.count == 0) continue;
      for (int axis = 0; axis < 2; ++axis) {
        low_[axis] = std::min(low_[axis], own.low[axis]);
        high_[axis] = std::max(high_[axis], own.high[axis]);
      }
    }
  }

  static std::pair<float, float> bounds(const float* values, int64_t count) {
    float low = values[0], high = values[0];
    for (int64_t i = 1; i < count; ++i) {
      low = values[i] < low ? values[i] : low;
      high = values[i] > high ? values[i] : high;
    }
    return {low, high};
  }

  void count_in_cells(const double* spans, double edge) {
    const auto along = [&](int axis) {
      return CellsAlong{low_[axis], static_cast<float>(1 / edge), static_cast<int64_t>(spans[axis] / edge) + 5};
    };
    cells_ = {along(0), along(1)};
    counts_.assign(static_cast<size_t>(cells_.size()), 0);
    parallel_for(context_, static_cast<int64_t>(pieces_.size()), 1, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t piece = first; piece < last; ++piece)
        for (int64_t i = 0; i < pieces_[static_cast<size_t>(piece)].count; i += kLanes) {
          const int64_t at = piece * kRoom + i;
          store(cell_ + at, cells_.of(load<FloatRegister>(down_ + at), load<FloatRegister>(right_ + at)));
        }
    });
    for (size_t piece = 0; piece < pieces_.size(); ++piece) {
      const int64_t begin = static_cast<int64_t>(piece) * kRoom;
      for (int64_t i = begin; i < begin + pieces_[piece].count; ++i)
        counts_[static_cast<size_t>(cell_[i])] += 1 + near_[i] * kNear;
    }
  }

  static int64_t num_near(uint64_t counts) { return static_cast<int64_t>(counts / kNear); }
  static int64_t num_all(uint64_t counts) { return static_cast<int64_t>(counts % kNear); }

  bool is_sparse() const {
    int64_t lonely = 0, held = 0;
    for (const uint64_t counts : counts_) {
      lonely += static_cast<int64_t>(num_near(counts) == 1);
      held += static_cast<int64_t>(num_near(counts) > 0);
    }
    return !(static_cast<double>(lonely) <= kMostLonely * static_cast<double>(held));
  }

  // Mark the cells in which points near the plane are no rarer than usual.
  void mark_usual() {
    std::vector<int64_t> share(counts_.size());
    int64_t sum = 0;
    for (size_t i = 0; i < counts_.size(); ++i) {
      const int64_t own = num_near(counts_[i]);
      if (own == 0) continue;
      share[i] = (own << kShareBits) / num_all(counts_[i]);
      sum += own * share[i];
    }
    for (size_t i = 0; i < counts_.size(); ++i)
      marked_[i] = num_near(counts_[i]) > 0 && share[i] * (kCrossed * num_near_) >= sum;
  }

  // Add the empty cells beside marked ones.
  void add_rim() {
    const int64_t height = cells_.rows.count, width = cells_.columns.count;
    const std::vector<uint8_t> marked(marked_, marked_ + height * width);
    for (int64_t row = 1; row + 1 < height; ++row) {
      for (int64_t column = 1; column + 1 < width; ++column) {
        const int64_t cell = row * width + column;
        if (!marked[static_cast<size_t>(cell)]) continue;
        for (int64_t down = -width; down <= width; down += width) {
          for (int64_t other = cell + down - 1; other <= cell + down + 1; ++other)
            marked_[other] |= static_cast<uint8_t>(num_near(counts_[static_cast<size_t>(other)]) == 0);
        }
      }
    }
  }

  const pc_context& context_;
  int64_t stride_, num_near_ = 0;
  bool is_too_far_ = false;
  std::vector<Piece> pieces_;
  float *down_ = nullptr, *right_ = nullptr;
  uint8_t* near_ = nullptr;
  int32_t* cell_ = nullptr;
  float low_[2] = {std::numeric_limits<float>::infinity(), std::numeric_limits<float>::infinity()};
  float high_[2] = {-std::numeric_limits<float>::infinity(), -std::numeric_limits<float>::infinity()};
  FlatCells cells_{};
  std::vector<uint64_t> counts_;
  uint8_t* marked_ = nullptr;
};

}  // namespace pc::planes
