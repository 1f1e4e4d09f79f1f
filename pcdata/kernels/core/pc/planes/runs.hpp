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

#include "pc/memory.hpp"
#include "pc/planes/plane_sums.hpp"
#include "pc/threads.hpp"

namespace pc::planes {

constexpr int kRun = 64;             // points
constexpr int64_t kRunsAtOnce = 16;  // clouds have multiples of so many runs, whatever a register holds

// Float operations of a distance are off by less than this part of the largest number that enters.
constexpr float kRounding = 1e-6F;
constexpr float kHuge = 1e15F;  // beyond, products may be infinite: nothing is known of such a run

inline int64_t runs_of(int64_t points) {
  return ((points + kRun - 1) / kRun + kRunsAtOnce - 1) / kRunsAtOnce * kRunsAtOnce;
}

constexpr int kFacts = 8;

// The runs of one cloud, with one array per number; `size` is a whole number.
struct Runs {
  const float *first_x, *first_y, *first_z, *last_x, *last_y, *last_z, *reach, *size;
  int64_t count;
  const float* points;  // of the cloud
  int64_t num_points;

  // The numbers are `num_runs` apart.
  Runs(const float* numbers, int64_t num_runs, const float* own_points, int64_t count_of_points)
      : count(num_runs), points(own_points), num_points(count_of_points) {
    const float** const facts[kFacts] = {&first_x, &first_y, &first_z, &last_x, &last_y, &last_z, &reach, &size};
    for (int k = 0; k < kFacts; ++k) *facts[k] = numbers + k * num_runs;
  }
};

// The points of a run of a cloud, of which 64 can be read: where it has fewer, a copy that ends with others.
class RunPoints {
 public:
  RunPoints(const float* points, int64_t num_points, int64_t run, bool repeat_last = false)
      : size_(static_cast<int>(std::clamp<int64_t>(num_points - kRun * run, 0, kRun))), at_(points + 3 * kRun * run) {
    if (size_ == kRun) return;
    const float nan = std::numeric_limits<float>::quiet_NaN();
    std::copy_n(at_, 3 * size_, copy_);
    for (int i = 3 * size_; i < 3 * kRun; ++i) copy_[i] = repeat_last && size_ > 0 ? copy_[i - 3] : nan;
    at_ = copy_;
  }
  RunPoints(const Runs& runs, int64_t run) : RunPoints(runs.points, runs.num_points, run) {}
  RunPoints(const RunPoints&) = delete;
  RunPoints& operator=(const RunPoints&) = delete;

  int size() const { return size_; }
  const float* point(int i) const { return at_ + 3 * i; }

  // Call body(x, y, z, i) for registers of points, the first of them the i-th.
  template <class Body>
  void each(const Body& body) const {
    for (int i = 0; i < kRun; i += kLanes) {
      FloatRegister x, y, z;
      load_points(at_ + 3 * i, x, y, z);
      body(x, y, z, i);
    }
  }

 private:
  int size_;
  const float* at_;
  float copy_[3 * kRun];
};

// Write what is known of a run, number by number `stride` apart.
inline void bound_run(const float* points, int64_t num_points, int64_t run, float* facts, int64_t stride) {
  const RunPoints own(points, num_points, run, true);
  if (own.size() == 0) {
    for (int k = 0; k < kFacts; ++k) facts[k * stride] = 0;
    return;
  }
  const float *first = own.point(0), *last = own.point(own.size() - 1);
  const float dx = last[0] - first[0], dy = last[1] - first[1], dz = last[2] - first[2];
  const float square = squared_length(dx, dy, dz);
  const float inverse = square > 0 ? 1 / square : 0;
  const FloatRegister none = {}, one = none + 1;
  FloatRegister largest = {}, farthest = {};
  own.each([&](const FloatRegister& x, const FloatRegister& y, const FloatRegister& z, int) {
    largest = maximum(largest, maximum(magnitude(x), maximum(magnitude(y), magnitude(z))));
    const FloatRegister px = x - first[0], py = y - first[1], pz = z - first[2];
    // Whatever the rounding, any point of the segment bounds the distance to it.
    const FloatRegister t = minimum(maximum((px * dx + py * dy + pz * dz) * inverse, none), one);
    farthest = maximum(farthest, squared_length(px - t * dx, py - t * dy, pz - t * dz));
  });
  const float most = highest_lane<float>(largest);
  float reach = 1.00001F * std::sqrt(highest_lane<float>(farthest)) + 3 * kRounding * most;
  if (!(most < kHuge)) reach = std::numeric_limits<float>::infinity();
  for (int axis = 0; axis < 3; ++axis) facts[axis * stride] = first[axis], facts[(3 + axis) * stride] = last[axis];
  facts[6 * stride] = reach;
  facts[7 * stride] = static_cast<float>(own.size());
}

// Find out about all runs of a cloud; memory is the scratch's, until its frame ends.
inline Runs bound_runs(const pc_context& context, const float* points, int64_t count, ScratchFrame& scratch) {
  const int64_t num_runs = runs_of(count);
  auto* facts = scratch.take<float>(kFacts * num_runs);
  parallel_for(context, num_runs, 128, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t run = begin; run < end; ++run) bound_run(points, count, run, facts + run, num_runs);
  });
  return {facts, num_runs, points, count};
}

// What is known of a register of runs: all points are near the plane, none is, or neither is certain.
struct RunMasks {
  RegisterMask inside, open;
};

// By how much all points are near, or none is; not above 0 where that is not certain.
struct RunMargins {
  FloatRegister inside, outside;
};

class RunTest {
 public:
  RunTest(const Plane& plane, float distance)
      : plane_(plane),
        inside_(distance - kRounding * std::fabs(plane.d)),
        outside_(distance + kRounding * std::fabs(plane.d)) {}

  RunMargins margins(const Runs& runs, int64_t i) const {
    const FloatRegister none = {};
    const FloatRegister a = offset(runs.first_x + i, runs.first_y + i, runs.first_z + i);
    const FloatRegister b = offset(runs.last_x + i, runs.last_y + i, runs.last_z + i);
    const FloatRegister near = magnitude(a), far = magnitude(b), reach = load<FloatRegister>(runs.reach + i);
    const FloatRegister least = select(less(none, a * b), minimum(near, far), none);  // 0 where the plane lies between
    return {inside_ - (maximum(near, far) + reach), (least - reach) - outside_};
  }
  RunMasks operator()(const Runs& runs, int64_t i) const {
    const FloatRegister none = {};
    const RunMargins own = margins(runs, i);
    return {less(none, own.inside), less_equal(own.outside, none)};
  }

 private:
  FloatRegister offset(const float* x, const float* y, const float* z) const {
    return ((plane_.x * load<FloatRegister>(x) + plane_.y * load<FloatRegister>(y)) +
            plane_.z * load<FloatRegister>(z)) +
           plane_.d;
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
      RunPoints(runs, run).each([&](const FloatRegister& x, const FloatRegister& y, const FloatRegister& z, int) {
        near -= is_near(plane, distance, x, y, z);
      });
      most -= static_cast<int64_t>(runs.size[run]) - sum_of_lanes(near);
    }
    if (most <= floor) return -1;
  }
  return most;
}

}  // namespace pc::planes
