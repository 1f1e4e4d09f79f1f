// Boxes around points.
#pragma once

#include "pc/math/distance.hpp"

namespace pc::math {

struct Bounds {
  float low[3], high[3];

  PC_HD static Bounds of_point(const float* p) { return {{p[0], p[1], p[2]}, {p[0], p[1], p[2]}}; }

  PC_HD void include(int axis, float lower, float upper) {
    low[axis] = lower < low[axis] ? lower : low[axis];
    high[axis] = upper > high[axis] ? upper : high[axis];
  }
  PC_HD void include(const float* point) {
    for (int axis = 0; axis < 3; ++axis) include(axis, point[axis], point[axis]);
  }
  PC_HD void include(const Bounds& other) {
    for (int axis = 0; axis < 3; ++axis) include(axis, other.low[axis], other.high[axis]);
  }
  PC_HD float length(int axis) const { return high[axis] - low[axis]; }
  PC_HD int longest_axis() const {
    int longest = 0;
    for (int axis = 1; axis < 3; ++axis)
      if (length(axis) > length(longest)) longest = axis;
    return longest;
  }
  // In double, where the difference of two floats is exact.
  PC_HD double exact_length(int axis) const { return static_cast<double>(high[axis]) - static_cast<double>(low[axis]); }
  PC_HD double extent() const { return larger(larger(exact_length(0), exact_length(1)), exact_length(2)); }
};

// Squared distance between boxes, never more than that of any two points in them as computed: rounding is monotone and
// the operations are those of squared_distance in the same order.
PC_HD float squared_gap(const Bounds& a, const Bounds& b) {
  float apart[3];
  for (int axis = 0; axis < 3; ++axis) {
    const float after = a.low[axis] - b.high[axis], before = b.low[axis] - a.high[axis];
    const float most = after < before ? before : after;
    apart[axis] = 0.0f < most ? most : 0.0f;
  }
  return squared_distance(apart[0], apart[1], apart[2], 0, 0, 0);
}

}  // namespace pc::math
