// Runs of points, and how near to a plane all points of a run are: most planes are counted without a look at most
// points.
//
// A run is 64 points that follow each other. All lie within `reach` of the segment from its first to its last; so their
// distances from a plane lie within `reach` of the distances between those of its ends. On a depth image such a run is
// a piece of a row, and where it shows one smooth surface, `reach` is noise.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "pc/planes/plane_sums.hpp"
#include "pc/threads.hpp"

namespace pc::planes {

constexpr int64_t kRun = 64;         // points
constexpr int64_t kRunsAtOnce = 16;  // clouds begin at multiples of so many runs, whatever a register holds

// Float operations of a distance are off by less than this part of the largest number that enters.
constexpr float kRounding = 1e-6F;
constexpr float kHuge = 1e15F;  // beyond, products may be infinite: nothing is known of such a run

inline int64_t runs_of(int64_t points) {
  return ((points + kRun - 1) / kRun + kRunsAtOnce - 1) / kRunsAtOnce * kRunsAtOnce;
}

// One array per number of a run; `size` is a whole number.
struct Runs {
  const float *first_x, *first_y, *first_z, *last_x, *last_y, *last_z, *reach, *size;
  const float *x, *y, *z;  // of all points, 64 per run, NaN where a run has fewer
  int64_t count;

  Runs(const float* runs, const float* columns, int64_t num_runs, int64_t begin, int64_t end) : count(end - begin) {
    const float** const facts[8] = {&first_x, &first_y, &first_z, &last_x, &last_y, &last_z, &reach, &size};
    for (int k = 0; k < 8; ++k) *facts[k] = runs + k * num_runs + begin;
    const float** const axes[3] = {&x, &y, &z};
    for (int k = 0; k < 3; ++k) *axes[k] = columns + kRun * (k * num_runs + begin);
  }
};

// What is known of a register of runs: all points are near the plane, none is, or neither is certain.
struct RunMasks {
  RegisterMask inside, open;
};

class RunTest {
 public:
  RunTest(const Plane& plane, float distance)
      : plane_(plane),
        inside_(distance - kRounding * std::fabs(plane.d)),
        outside_(distance + kRounding * std::fabs(plane.d)) {}

  RunMasks operator()(const Runs& runs, int64_t i) const {
    const FloatRegister none = {};
    const FloatRegister a = offset(runs.first_x + i, runs.first_y + i, runs.first_z + i);
    const FloatRegister b = offset(runs.last_x + i, runs.last_y + i, runs.last_z + i);
    const FloatRegister near = magnitude(a), far = magnitude(b), reach = load<FloatRegister>(runs.reach + i);
    const FloatRegister least = select(less(none, a * b), minimum(near, far), none);  // 0 where the plane lies between
    const RegisterMask inside = less(maximum(near, far) + reach, none + inside_);
    const RegisterMask maybe = less_equal(least - reach, none + outside_);
    return {inside, maybe};
  }

 private:
  FloatRegister offset(const float* x, const float* y, const float* z) const {
    return ((plane_.x * load<FloatRegister>(x) + plane_.y * load<FloatRegister>(y)) +
            plane_.z * load<FloatRegister>(z)) +
           plane_.d;
  }
  static FloatRegister magnitude(const FloatRegister& value) {
    return reinterpret_cast<FloatRegister>(reinterpret_cast<Int32Register>(value) & 0x7FFFFFFF);
  }

  Plane plane_;
  float inside_, outside_;
};

struct CountBounds {
  int64_t least, most;
};

// Between how many and how many points are near a plane.
inline CountBounds bound_count(const Runs& runs, const RunTest& test) {
  Int32Register least = {}, most = {};
  const Int32Register none = {};
  for (int64_t i = 0; i < runs.count; i += kLanes) {
    const RunMasks masks = test(runs, i);
    const Int32Register size = truncated(load<FloatRegister>(runs.size + i));
    least += select(masks.inside, size, none);
    most += select(masks.open, size, none);
  }
  return {sum_of_lanes(least), sum_of_lanes(most)};
}

// The points near a plane; or -1 once it is certain that they are no more than `floor`.
inline int64_t count_above(const Runs& runs, const RunTest& test, const Plane& plane, float distance, int64_t most,
                           int64_t floor) {
  for (int64_t i = 0; i < runs.count; i += kLanes) {
    const RunMasks masks = test(runs, i);
    for (uint32_t bits = masks.open.bits() & ~masks.inside.bits(); bits != 0; bits &= bits - 1) {
      const int64_t run = i + __builtin_ctz(bits);
      Int32Register near = {};
      for (int64_t p = kRun * run; p < kRun * (run + 1); p += kLanes)
        near -= is_near(plane, distance, load<FloatRegister>(runs.x + p), load<FloatRegister>(runs.y + p),
                        load<FloatRegister>(runs.z + p));
      most -= static_cast<int64_t>(runs.size[run]) - sum_of_lanes(near);
    }
    if (most <= floor) return -1;
  }
  return most;
}

}  // namespace pc::planes
