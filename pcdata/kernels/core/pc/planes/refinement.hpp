// Refitting a plane to the points near it until those no longer change.
#pragma once

#include "pc/math/eigen.hpp"
#include "pc/planes/followed_points.hpp"

namespace pc::planes {

struct RefinementRules {
  float distance;
  double flat, max_tilt;
  int64_t rounds;
};

inline Plane rounded(const double* plane) {
  return {static_cast<float>(plane[0]), static_cast<float>(plane[1]), static_cast<float>(plane[2]),
          static_cast<float>(plane[3])};
}

inline bool is_within_tilt(const double* plane, const double* up, double max_tilt) {
  if (up == nullptr) return true;
  constexpr double kHalfTurn = 3.14159265358979323846;
  const math::Vector3 normal{plane[0], plane[1], plane[2]}, along{up[0], up[1], up[2]};
  const double angle = std::atan2(fused_length(cross(normal, along)), dot(normal, along));
  return std::min(angle, kHalfTurn - angle) <= max_tilt;
}

// Refines the plane of one cloud.
class Refinement {
 public:
  Refinement(const pc_context& context, const Runs& runs, const RefinementRules& rules, const double* up)
      : context_(context), runs_(runs), rules_(rules), up_(up) {}

  void run(double* plane, uint8_t* near, ScratchFrame& scratch) const {
    Plane now = rounded(plane);
    const int64_t first = first_near(now);
    if (first < 0) {
      std::fill_n(near, runs_.num_points, uint8_t{0});
      return;
    }
    // Offsets from a point of the plane are no longer than the plane is wide, so their squares keep their digits.
    const math::Vector3 center = math::vector_of(runs_.points + 3 * first);
    const double about[3] = {center.x, center.y, center.z};
    FollowedPoints followed(context_, runs_, rules_.distance, about, scratch);
    followed.start(now);
    for (int64_t round = 0; round < rules_.rounds; ++round) {
      double fitted[4];
      if (!fit(followed, about, fitted) || !is_within_tilt(fitted, up_, rules_.max_tilt)) break;
      const Plane next = rounded(fitted);
      const bool changed = followed.move(now, next);
      if (followed.sums().values[0] < 3) {
        followed.start(now);
        break;
      }
      std::copy_n(fitted, 4, plane);
      now = next;
      if (!changed) break;
    }
    write(followed, near);
  }

 private:
  int64_t first_near(const Plane& plane) const {
    const RunTest test(plane, rules_.distance);
    for (int64_t i = 0; i < runs_.count; i += kLanes)
      for (uint32_t open = test(runs_, i).open.bits(); open != 0; open &= open - 1) {
        const int64_t begin = kRun * (i + __builtin_ctz(open)), end = std::min(begin + kRun, runs_.num_points);
        for (int64_t k = begin; k < end; ++k)
          if (plane.is_near(runs_.points + 3 * k, rules_.distance)) return k;
      }
    return -1;
  }

  // False where the points are fewer than three, or lie on a line.
  bool fit(const FollowedPoints& followed, const double* about, double* plane) const {
    const math::Moments moments = followed.sums().moments();
    if (moments.count < 3) return false;
    const math::LeastVarying found = least_varying(covariance(moments));
    const double width = std::sqrt(std::max(found.next, 0.0));
    if (width <= rules_.flat * static_cast<double>(followed.largest()) &&
        width <= rules_.flat * largest_coordinate(followed))
      return false;
    const math::Vector3& n = found.direction;
    const double x = n.x * (about[0] + moments.x / moments.count), y = n.y * (about[1] + moments.y / moments.count),
                 z = n.z * (about[2] + moments.z / moments.count);
    plane[0] = n.x, plane[1] = n.y, plane[2] = n.z;
    plane[3] = -((x + z) + y);
    return true;
  }

  // Of the points that are near.
  double largest_coordinate(const FollowedPoints& followed) const {
    float largest = 0;
    for (int64_t run = 0; run < runs_.count; ++run)
      for (uint64_t bits = followed.near(run); bits != 0; bits &= bits - 1) {
        const float* p = runs_.points + 3 * (kRun * run + __builtin_ctzll(bits));
        for (int axis = 0; axis < 3; ++axis) largest = std::max(largest, std::fabs(p[axis]));
      }
    return largest;
  }

  void write(const FollowedPoints& followed, uint8_t* near) const {
    parallel_for(context_, (runs_.num_points + kRun - 1) / kRun, 1024, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t run = begin; run < end; ++run) {
        const auto size = static_cast<int>(std::min<int64_t>(kRun, runs_.num_points - kRun * run));
        spread_bits(followed.near(run), size, near + kRun * run);
      }
    });
  }

  const pc_context& context_;
  const Runs& runs_;
  const RefinementRules& rules_;
  const double* up_;
};

}  // namespace pc::planes
