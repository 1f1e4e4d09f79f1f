// The points near a plane that moves a little, again and again, and their moments: of most runs of points it is known
// that the step was too short to change them.
#pragma once

#include <atomic>

#include "pc/math/normal.hpp"
#include "pc/memory.hpp"
#include "pc/planes/runs.hpp"

namespace pc::planes {

// Sums over points near a plane, as offsets from a center.
struct NearSums {
  static constexpr int kSize = 10;
  double values[kSize];  // count, x, y, z, xx, xy, xz, yy, yz, zz

  void add(const NearSums& other) {
    for (int k = 0; k < kSize; ++k) values[k] += other.values[k];
  }
  math::Moments moments() const {
    const double* v = values;
    return {v[0], v[1], v[2], v[3], {v[4], v[5], v[6], v[7], v[8], v[9]}};
  }
};

inline uint64_t first_bits(int count) { return count >= 64 ? ~uint64_t{0} : (uint64_t{1} << count) - 1; }

// Write bits as bytes of 0 and 1.
inline void spread_bits(uint64_t bits, int count, uint8_t* to) {
  if (bits == 0 || bits == first_bits(count)) {
    std::fill_n(to, count, static_cast<uint8_t>(bits & 1));
    return;
  }
  for (int i = 0; i < count; ++i) to[i] = static_cast<uint8_t>(bits >> i & 1);
}

// Added in eight lanes, whatever the instruction set.
inline NearSums sum_chosen(const RunPoints& points, uint64_t chosen, const double* center) {
  alignas(64) float axes[3][kRun];
  points.each([&](const FloatRegister& x, const FloatRegister& y, const FloatRegister& z, int i) {
    store(axes[0] + i, x);
    store(axes[1] + i, y);
    store(axes[2] + i, z);
  });
  PlaneMoments sums;
  for (int i = 0; i < kRun; i += 8) {
    const auto mine = static_cast<int64_t>(chosen >> i & 0xFF);
    if (mine == 0) continue;
    constexpr Long8 places = {1, 2, 4, 8, 16, 32, 64, 128};
    const Long8 taken = ((places & mine) != 0);
    Double8 offset[3];
    for (int axis = 0; axis < 3; ++axis) {
      const Double8 value = __builtin_convertvector(load<Float8>(axes[axis] + i), Double8) - center[axis];
      offset[axis] = reinterpret_cast<Double8>(reinterpret_cast<Long8>(value) & taken);
    }
    sums.add(offset[0], offset[1], offset[2]);
  }
  const auto total = [](const Double8& lanes) {
    return reduce<double>(lanes, [](const auto& a, const auto& b) { return a + b; });
  };
  return {{static_cast<double>(__builtin_popcountll(chosen)), total(sums.x), total(sums.y), total(sums.z),
           total(sums.xx), total(sums.xy), total(sums.xz), total(sums.yy), total(sums.yz), total(sums.zz)}};
}

// Of each run it keeps which points are near, their sums, and its slack: how far the plane may still move, as seen from
// any of the run's points, before one of them comes or goes.
class FollowedPoints {
 public:
  // Memory is the scratch's, until its frame ends. Sums are about the center.
  FollowedPoints(const pc_context& context, const Runs& runs, float distance, const double* center,
                 ScratchFrame& scratch)
      : context_(context), runs_(runs), distance_(distance), center_(center), num_groups_(runs.count / kRunsAtOnce) {
    slack_ = scratch.take<float>(runs.count);
    near_ = scratch.take<uint64_t>(runs.count);
    sums_ = scratch.take<NearSums>(runs.count);
    group_sums_ = scratch.take<NearSums>(num_groups_);
    std::fill_n(near_, runs.count, 0);
    std::fill_n(sums_, runs.count, NearSums{});
    std::fill_n(group_sums_, num_groups_, NearSums{});
    largest_ = bound_coordinates();
  }

  // A number that no coordinate exceeds.
  float largest() const { return largest_; }
  uint64_t near(int64_t run) const { return near_[run]; }

  // Take the points near a plane, whatever was before.
  void start(const Plane& plane) {
    std::fill_n(slack_, runs_.count, -1.0F);
    step_to(plane, plane);
  }

  // Let the plane move; true where other points are near it than before.
  bool move(const Plane& from, const Plane& to) { return step_to(from, to); }

  NearSums sums() const {
    NearSums all{};
    for (int64_t group = 0; group < num_groups_; ++group) all.add(group_sums_[group]);
    return all;
  }

 private:
  static constexpr int64_t kGroups = 32;  // that one thread takes at a time: up to 50 us

  // How far a plane moves, seen from a run: no more than from one of its ends, and `turn` for each unit of its reach.
  struct Step {
    Plane change;
    float turn, rounding;
  };

  bool step_to(const Plane& from, const Plane& to) {
    const Plane change{to.x - from.x, to.y - from.y, to.z - from.z, to.d - from.d};
    const float turn = std::fabs(change.x) + std::fabs(change.y) + std::fabs(change.z);
    const Step step{change, turn, kRounding * (turn * largest_ + std::fabs(change.d))};
    // What rounding does to distances from the plane when a run is looked at, and when it is not.
    const float doubt = 2 * kRounding * (3 * largest_ + std::fabs(to.d));
    const RunTest test(to, distance_);
    std::atomic<bool> changed{false};
    parallel_for(context_, num_groups_, kGroups, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t group = begin; group < end; ++group) {
        const uint32_t open = runs_in_doubt(group, step);
        if (open == 0 || !look_at(group, open, test, to, doubt)) continue;
        group_sums_[group] = {};
        for (int64_t k = 0; k < kRunsAtOnce; ++k) group_sums_[group].add(sums_[kRunsAtOnce * group + k]);
        changed.store(true, std::memory_order_relaxed);
      }
    });
    return changed.load();
  }

  uint32_t runs_in_doubt(int64_t group, const Step& step) const {
    uint32_t open = 0;
    for (int64_t k = 0; k < kRunsAtOnce; k += kLanes) {
      const int64_t i = kRunsAtOnce * group + k;
      const auto at = [&](const float* facts) { return load<FloatRegister>(facts + i); };
      const FloatRegister first =
          magnitude(offset_from(step.change, at(runs_.first_x), at(runs_.first_y), at(runs_.first_z)));
      const FloatRegister last =
          magnitude(offset_from(step.change, at(runs_.last_x), at(runs_.last_y), at(runs_.last_z)));
      const FloatRegister moved = maximum(first, last) + (step.turn * at(runs_.reach) + step.rounding);
      const FloatRegister left = at(slack_) * (1 - kRounding) - moved;
      store(slack_ + i, left);
      const FloatRegister none = {};
      open |= (less(none, left).bits() ^ all_lanes().bits()) << k;  // NaN is in doubt too
    }
    return open;
  }

  // Look at some runs of a group again; true if points came or went.
  bool look_at(int64_t group, uint32_t open, const RunTest& test, const Plane& plane, float doubt) {
    float inside[kRunsAtOnce], outside[kRunsAtOnce];
    for (int64_t k = 0; k < kRunsAtOnce; k += kLanes) {
      const RunMargins margins = test.margins(runs_, kRunsAtOnce * group + k);
      store(inside + k, margins.inside);
      store(outside + k, margins.outside);
    }
    bool changed = false;
    for (; open != 0; open &= open - 1) {
      const int k = __builtin_ctz(open);
      const int64_t run = kRunsAtOnce * group + k;
      const RunPoints points(runs_, run);
      uint64_t near = 0;
      if (inside[k] > 0 || outside[k] > 0) {
        near = inside[k] > 0 ? first_bits(points.size()) : 0;
        slack_[run] = std::max(inside[k], outside[k]) - doubt;
      } else {
        near = look_at_points(points, plane, slack_[run]);
        slack_[run] -= doubt;
      }
      if (near == near_[run]) continue;
      near_[run] = near;
      sums_[run] = near == 0 ? NearSums{} : sum_chosen(points, near, center_);
      changed = true;
    }
    return changed;
  }

  // Which points of a run are near, and how far the nearest to the border is from it.
  uint64_t look_at_points(const RunPoints& points, const Plane& plane, float& slack) const {
    const FloatRegister limit = FloatRegister{} + distance_;
    FloatRegister least = FloatRegister{} + std::numeric_limits<float>::max();
    uint64_t near = 0;
    points.each([&](const FloatRegister& x, const FloatRegister& y, const FloatRegister& z, int i) {
      const FloatRegister away = magnitude(offset_from(plane, x, y, z));
      near |= static_cast<uint64_t>(less(away, limit).bits()) << i;
      least = minimum(magnitude(away - limit), least);  // NaN where there is no point
    });
    slack = lowest_lane<float>(least);
    return near;
  }

  float bound_coordinates() const {
    FloatRegister most = {};
    for (int64_t i = 0; i < runs_.count; i += kLanes) {
      const auto at = [&](const float* facts) { return magnitude(load<FloatRegister>(facts + i)); };
      const FloatRegister first = maximum(at(runs_.first_x), maximum(at(runs_.first_y), at(runs_.first_z)));
      const FloatRegister last = maximum(at(runs_.last_x), maximum(at(runs_.last_y), at(runs_.last_z)));
      most = maximum(maximum(first, last) + at(runs_.reach), most);
    }
    return highest_lane<float>(most);
  }

  const pc_context& context_;
  Runs runs_;
  float distance_;
  const double* center_;
  int64_t num_groups_;
  float largest_;
  float* slack_;
  uint64_t* near_;
  NearSums *sums_, *group_sums_;
};

}  // namespace pc::planes
