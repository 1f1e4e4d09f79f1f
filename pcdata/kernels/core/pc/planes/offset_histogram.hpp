// How many points can be near planes that lie close to a known one: most planes through a table are told from its best
// without a look at any point.
#pragma once

#include "pc/math/vector.hpp"
#include "pc/planes/runs.hpp"
#include "pc/planes/scored_points.hpp"

namespace pc::planes {

// Points in square cells of a plane, and in every cell a histogram of their offsets along the plane's normal. Seen from
// one cell another plane is a narrow range of offsets; so many points as it holds, widened by what the plane rises
// within the cell and by what floats round, are near the plane at most. Points beyond the cells are counted by runs.
class OffsetHistogram {
 public:
  // About a plane, with cells around those of some points that are near it; scratch memory is kept.
  OffsetHistogram(const pc_context& context, const Runs& runs, const Plane& about, float distance,
                  const ScoredPoints& some, ScratchFrame& scratch)
      : distance_(distance) {
    if (!place_cells(about, some)) return;
    const int64_t num_pieces = std::min<int64_t>(kMostPieces, std::max<int64_t>(1, context.threads));
    const int64_t of_piece = (runs.count + num_pieces - 1) / num_pieces;
    auto* pieces = scratch.take<uint32_t>(num_pieces * kSize);
    auto* largest = scratch.take<float>(num_pieces);
    auto* beyond = scratch.take<float>(runs.count);  // points of each run that lie in no cell
    parallel_for(context, num_pieces, 1, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t piece = first; piece < last; ++piece) {
        uint32_t* own = pieces + piece * kSize;
        std::fill_n(own, kSize, 0);
        const int64_t end = std::min(runs.count, (piece + 1) * of_piece);
        largest[piece] = sort_in(runs, piece * of_piece, end, own, beyond);
      }
    });
    largest_ = *std::max_element(largest, largest + num_pieces);
    add_up(pieces, num_pieces, scratch);
    keep_beyond(runs, beyond, scratch);
    known_ = true;
  }

  // False where cells cannot be placed.
  bool is_known() const { return known_; }

  // Whether a plane is close enough to the known one to be seen as a range of offsets.
  bool sees(const Plane& plane) const { return std::fabs(along(plane, normal_)) >= kLeastCosine; }

  // Points near a plane that it sees, at most.
  int64_t most(const Plane& plane) const {
    const double cosine = along(plane, normal_),
                 rise[2] = {along(plane, axes_[0]) / cosine, along(plane, axes_[1]) / cosine};
    const double level = static_cast<double>(plane.d) / cosine, width = static_cast<double>(distance_);
    const double within = std::fabs(rise[0]) * half_[0] + std::fabs(rise[1]) * half_[1];
    // What floats do to offsets and places of points, to distances from the plane, and to the sums below.
    const double doubt = 3e-5 * (static_cast<double>(largest_) + std::fabs(static_cast<double>(plane.d))) +
                         1e-6 * (width + std::fabs(static_cast<double>(lowest_)));
    const double reach = (width + doubt) / std::fabs(cosine) + 1.001 * within + 1e-3 / static_cast<double>(per_bin_);
    const auto down = static_cast<float>(rise[0]), right = static_cast<float>(rise[1]);
    const auto low = static_cast<float>(-level - reach), high = static_cast<float>(-level + reach);
    Int32Register total = {};
    const auto* sums = reinterpret_cast<const int32_t*>(sums_);
    for (int64_t i = 0; i < num_cells_; i += kLanes) {
      const FloatRegister lift = down * load<FloatRegister>(down_ + i) + right * load<FloatRegister>(right_ + i);
      const auto cell = load<Int32Register>(cell_ + i);
      total += gather(sums, cell + bin_of(high - lift) + 1) - gather(sums, cell + bin_of(low - lift));
    }
    const int64_t inside = sum_of_lanes(total);
    return inside + (beyond_.count == 0 ? 0 : bound_count(beyond_, {plane, distance_}).most);
  }

 private:
  static constexpr int kSide = 32;             // cells
  static constexpr int kBins = 64;             // of offsets; beyond them are one more at each end
  static constexpr float kBinsToDistance = 8;  // the finest a border is known, beside what a plane rises in a cell
  static constexpr int kStride = kBins + 3;    // sums of all bins before each, and of all
  static constexpr int64_t kSize = (kSide * kSide + 1) * kStride;  // and a cell without points
  static constexpr int64_t kMostPieces = 8;
  static constexpr double kLeastCosine = 0.2;
  static constexpr size_t kFewPoints = 32;

  static double along(const Plane& plane, const math::Vector3& axis) {
    return dot({static_cast<double>(plane.x), static_cast<double>(plane.y), static_cast<double>(plane.z)}, axis);
  }
  static FloatRegister along(const float* axis, const FloatRegister& x, const FloatRegister& y,
                             const FloatRegister& z) {
    return (axis[0] * x + axis[1] * y) + axis[2] * z;
  }

  bool place_cells(const Plane& about, const ScoredPoints& some) {
    const math::Vector3 given = {static_cast<double>(about.x), static_cast<double>(about.y),
                                 static_cast<double>(about.z)};
    if (!(distance_ > 1e-20F && distance_ < kHuge) || !(dot(given, given) > 0.5 && dot(given, given) < 2)) return false;
    normal_ = math::unit(given);
    const double x = std::fabs(normal_.x), y = std::fabs(normal_.y), z = std::fabs(normal_.z);
    const math::Vector3 across = x <= y && x <= z ? math::Vector3{1, 0, 0}
                                 : y <= z         ? math::Vector3{0, 1, 0}
                                                  : math::Vector3{0, 0, 1};
    axes_[0] = math::unit(cross(normal_, across));
    axes_[1] = cross(normal_, axes_[0]);
    const math::Vector3* const all[3] = {&axes_[0], &axes_[1], &normal_};
    for (int k = 0; k < 3; ++k) {
      float_axes_[k][0] = static_cast<float>(all[k]->x);
      float_axes_[k][1] = static_cast<float>(all[k]->y);
      float_axes_[k][2] = static_cast<float>(all[k]->z);
    }
    per_bin_ = kBinsToDistance / distance_;
    lowest_ = -about.d - kBins / 2 / per_bin_;
    size_t found = 0;
    float low[2], high[2];
    std::fill_n(low, 2, std::numeric_limits<float>::max());
    std::fill_n(high, 2, -std::numeric_limits<float>::max());
    for (int64_t b = 0; b < some.num_blocks(); ++b) {
      const PointBlock& block = some.block(b);
      for (int i = 0; i < block.count; ++i) {
        const float p[3] = {block.x[i], block.y[i], block.z[i]};
        if (!about.is_near(p, distance_)) continue;
        ++found;
        for (int k = 0; k < 2; ++k) {
          const float *axis = float_axes_[k], at = (axis[0] * p[0] + axis[1] * p[1]) + axis[2] * p[2];
          low[k] = std::min(low[k], at);
          high[k] = std::max(high[k], at);
        }
      }
    }
    if (found < kFewPoints) return false;
    for (int k = 0; k < 2; ++k) {
      constexpr float kRoom = 0.1F;  // on each side, for points that were not among those
      const float span = high[k] - low[k];
      low_[k] = low[k] - kRoom * span;
      per_cell_[k] = kSide / ((1 + 2 * kRoom) * span);
      half_[k] = 0.501 / static_cast<double>(per_cell_[k]);
      if (!(span > 0 && high[k] < kHuge && low[k] > -kHuge && per_cell_[k] < kHuge)) return false;
    }
    return true;
  }

  // The bin of an offset, in rising order.
  Int32Register bin_of(const FloatRegister& offset) const {
    const FloatRegister none = {};
    return floored(minimum(maximum((offset - lowest_) * per_bin_, none - 1), none + static_cast<float>(kBins))) + 1;
  }

  // Count the points of some runs in cells and bins, each one place further on, and those that lie in no cell; return
  // what no coordinate of points in cells exceeds.
  float sort_in(const Runs& runs, int64_t begin, int64_t end, uint32_t* counts, float* beyond) const {
    FloatRegister largest = {};
    for (int64_t run = begin; run < end; ++run) {
      const RunPoints points(runs, run);
      alignas(64) int32_t place[kRun];
      points.each([&](const FloatRegister& x, const FloatRegister& y, const FloatRegister& z, int i) {
        const FloatRegister none = {}, side = none + static_cast<float>(kSide);
        const FloatRegister row = (along(float_axes_[0], x, y, z) - low_[0]) * per_cell_[0];
        const FloatRegister column = (along(float_axes_[1], x, y, z) - low_[1]) * per_cell_[1];
        const FloatRegister size = (magnitude(x) + magnitude(y)) + magnitude(z);
        const RegisterMask held = less_equal(none, row) & less(row, side) & less_equal(none, column) &
                                  less(column, side) & less(size, none + kHuge);  // no NaN
        largest = maximum(select(held, size, none), largest);
        const Int32Register cell = truncated(select(held, row, none)) * kSide + truncated(select(held, column, none));
        const Int32Register bin = bin_of(select(held, along(float_axes_[2], x, y, z), none));
        store(place + i, select(held, cell * kStride + bin + 1, Int32Register{} - 1));
      });
      int64_t outside = 0;
      for (int i = 0; i < points.size(); ++i) {
        if (place[i] < 0)
          ++outside;
        else
          ++counts[place[i]];
      }
      beyond[run] = static_cast<float>(outside);
    }
    return highest_lane<float>(largest);
  }

  // Make sums of the counts of all pieces, and a list of the cells that hold points.
  void add_up(uint32_t* pieces, int64_t num_pieces, ScratchFrame& scratch) {
    sums_ = pieces;
    down_ = scratch.take<float>(kSide * kSide + kLanes);
    right_ = scratch.take<float>(kSide * kSide + kLanes);
    cell_ = scratch.take<int32_t>(kSide * kSide + kLanes);
    const auto add_cell = [&](int cell, float row, float column) {
      down_[num_cells_] = low_[0] + row / per_cell_[0];
      right_[num_cells_] = low_[1] + column / per_cell_[1];
      cell_[num_cells_++] = cell * kStride;
    };
    for (int cell = 0; cell < kSide * kSide; ++cell) {
      uint32_t* own = sums_ + cell * kStride;
      for (int64_t piece = 1; piece < num_pieces; ++piece)
        for (int bin = 0; bin < kStride; ++bin) own[bin] += own[piece * kSize + bin];
      for (int bin = 1; bin < kStride; ++bin) own[bin] += own[bin - 1];
      if (own[kStride - 1] == 0) continue;
      add_cell(cell, static_cast<float>(cell / kSide) + 0.5F, static_cast<float>(cell % kSide) + 0.5F);
    }
    while (num_cells_ % kLanes != 0) add_cell(kSide * kSide, 0, 0);
  }

  // Keep what is known of the runs that reach beyond the cells, as if they had no other points.
  void keep_beyond(const Runs& runs, const float* beyond, ScratchFrame& scratch) {
    const int64_t count = runs.count - std::count(beyond, beyond + runs.count, 0.0F);
    const int64_t room = (count + kRunsAtOnce - 1) / kRunsAtOnce * kRunsAtOnce;
    auto* facts = scratch.take<float>(kFacts * room);
    std::fill_n(facts, kFacts * room, 0.0F);
    int64_t next = 0;
    const float* const from[kFacts] = {runs.first_x, runs.first_y, runs.first_z, runs.last_x,
                                       runs.last_y,  runs.last_z,  runs.reach,   beyond};
    for (int64_t run = 0; run < runs.count; ++run) {
      if (beyond[run] == 0) continue;
      for (int k = 0; k < kFacts; ++k) facts[k * room + next] = from[k][run];
      ++next;
    }
    beyond_ = Runs(facts, room, runs.points, runs.num_points);
  }

  float distance_;
  bool known_ = false;
  math::Vector3 normal_{}, axes_[2]{};
  float float_axes_[3][3]{};
  float low_[2]{}, per_cell_[2]{}, lowest_ = 0, per_bin_ = 0, largest_ = 0;
  double half_[2]{};
  uint32_t* sums_ = nullptr;  // (cells, bins) of all before
  float *down_ = nullptr, *right_ = nullptr;
  int32_t* cell_ = nullptr;
  int64_t num_cells_ = 0;
  Runs beyond_{nullptr, 0, nullptr, 0};
};

}  // namespace pc::planes
