// Polygons in a plane.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

// From (x, y) to another corner; in float64, with the operations of the reference.
struct Edge {
  double x, y, to_y, slope;

  // Whether a ray from the point toward larger x crosses the edge; a level one never is crossed.
  PC_HD bool is_right_of(double px, double py) const {
    return ((y <= py) != (to_y <= py)) & (px < x + (py - y) * slope);
  }
};

PC_HD Edge edge_between(const double* a, const double* b) {
  return {a[0], a[1], b[1], (b[0] - a[0]) / (b[1] == a[1] ? 1.0 : b[1] - a[1])};
}

}  // namespace pc::math
