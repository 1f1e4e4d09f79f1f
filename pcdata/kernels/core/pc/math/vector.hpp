// Vectors of three doubles.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

struct Vector3 {
  double x, y, z;
};

PC_HD Vector3 vector_of(const float* p) { return {p[0], p[1], p[2]}; }

PC_HD Vector3 difference(const Vector3& a, const Vector3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }

PC_HD Vector3 cross(const Vector3& a, const Vector3& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

PC_HD double dot(const Vector3& a, const Vector3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

// Fused, as torch's norm of a row is.
PC_HD double fused_length(const Vector3& v) { return sqrt(fma(v.z, v.z, fma(v.y, v.y, v.x * v.x))); }

PC_HD double largest_coordinate(const Vector3& v) { return larger(larger(fabs(v.x), fabs(v.y)), fabs(v.z)); }

PC_HD Vector3 unit(const Vector3& v) {
  const double length = sqrt(dot(v, v)), divisor = length > 0 ? length : 1.0;
  return {v.x / divisor, v.y / divisor, v.z / divisor};
}

PC_HD Vector3 choose(bool first, const Vector3& a, const Vector3& b) {
  return {first ? a.x : b.x, first ? a.y : b.y, first ? a.z : b.z};
}

}  // namespace pc::math
