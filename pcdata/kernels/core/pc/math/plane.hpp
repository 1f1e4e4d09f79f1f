// Planes and the points near them.
#pragma once

#include "pc/math/vector.hpp"

namespace pc::math {

// nx*x + ny*y + nz*z + d = 0.
struct Plane {
  float x, y, z, d;

  // In separate float operations like the reference.
  PC_HD bool is_near(const float* p, float distance) const {
#if defined(__CUDA_ARCH__)
    const float sum = __fadd_rn(__fadd_rn(__fmul_rn(x, p[0]), __fmul_rn(y, p[1])), __fmul_rn(z, p[2]));
    return fabsf(__fadd_rn(sum, d)) < distance;
#else
    return fabsf(((x * p[0] + y * p[1]) + z * p[2]) + d) < distance;
#endif
  }
};

// Write the plane (4,) through three points, with the float64 operations of the reference; NaN where they cannot be
// told from a line: their triangle is lower than `flat` of the largest coordinate.
PC_HD void plane_through(const Vector3& a, const Vector3& b, const Vector3& c, double flat, double* plane) {
  const Vector3 ab = difference(b, a), ac = difference(c, a), normal = cross(ab, ac);
  const double length = fused_length(normal);
  const double longest = larger(fused_length(ab), larger(fused_length(ac), fused_length(difference(c, b))));
  const double largest = larger(largest_coordinate(a), larger(largest_coordinate(b), largest_coordinate(c)));
  if (!(length > longest * (flat * largest))) {
    for (int i = 0; i < 4; ++i) plane[i] = nan("");
    return;
  }
  plane[0] = normal.x / length;
  plane[1] = normal.y / length;
  plane[2] = normal.z / length;
  plane[3] = -((plane[0] * a.x + plane[1] * a.y) + plane[2] * a.z);
}

}  // namespace pc::math
