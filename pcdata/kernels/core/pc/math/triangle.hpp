// Rays against triangles.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

// Where the ray (x, y, 1) meets a triangle: its depth, 0 where it misses, and the volumes over the edges, which are
// the weights of the corners but for their sum.
struct Meeting {
  double depth, volume[3];

  PC_HD double weight(int corner) const {
    const double sum = (volume[0] + volume[1]) + volume[2];
    return volume[corner] / (sum == 0 ? 1.0 : sum);
  }
};

// normal (3,), and sides (3, 3), the normals of the planes through the origin and an edge; with the operations of the
// reference.
PC_HD Meeting meet(const double* normal, double offset, const double* sides, double x, double y) {
  Meeting met{0, {}};
  bool all_above = true, all_below = true;
  for (int corner = 0; corner < 3; ++corner) {
    const double* side = sides + 3 * corner;
    const double volume = (side[0] * x + side[1] * y) + side[2];
    met.volume[corner] = volume;
    all_above &= volume >= 0;
    all_below &= volume <= 0;
  }
  const double total = (normal[0] * x + normal[1] * y) + normal[2];
  const bool inside = (all_above | all_below) & (total != 0);
  const double depth = offset / (inside ? total : 1.0);
  met.depth = inside & (depth > 0) ? depth : 0.0;
  return met;
}

}  // namespace pc::math
