// The direction in which a neighborhood varies least, in closed form.
//
// Source: Eberly, A robust eigensolver for 3x3 symmetric matrices, Geometric Tools, 2014-2023, the non-iterative
// algorithm, without its trigonometric functions: the one eigenvalue it needs comes from a cubic by Newton steps, the
// rotation in its second half from square roots. All selections are conditional moves, so loops over it vectorize.
#pragma once

#include "pc/math/vector.hpp"

namespace pc::math {

struct Symmetric3 {
  double xx, xy, xz, yy, yz, zz;
};

// Sums over the offsets of neighbors from their query: they keep all digits however far the cloud is from the origin.
struct Moments {
  double count, x, y, z;
  Symmetric3 square;
};

// Differences of covariances (scaled to entries of at most 1) and of unit vectors that are rounding, not shape.
constexpr double kRound = 1e-12;

PC_HD Vector3 times(const Symmetric3& m, const Vector3& v) {
  return {m.xx * v.x + m.xy * v.y + m.xz * v.z, m.xy * v.x + m.yy * v.y + m.yz * v.z,
          m.xz * v.x + m.yz * v.y + m.zz * v.z};
}

PC_HD Symmetric3 covariance(const Moments& m) {
  const double number = larger(m.count, 1.0);
  const double x = m.x / number, y = m.y / number, z = m.z / number;
  return {m.square.xx / number - x * x, m.square.xy / number - x * y, m.square.xz / number - x * z,
          m.square.yy / number - y * y, m.square.yz / number - y * z, m.square.zz / number - z * z};
}

// cos(acos(h) / 3) for 0 <= h <= 1: the largest root of 4 c^3 - 3 c = h, which lies between sqrt(3)/2 and 1, where the
// slope is 6 to 9. The parabola is within 2e-4 of it; each Newton step squares the error.
PC_HD double cosine_of_third(double h) {
  double c = 0.8660254037844386 + h * (0.1606942 - 0.0267196 * h);
  for (int step = 0; step < 3; ++step) c -= ((4 * c * c - 3) * c - h) / (12 * c * c - 3);
  return c;
}

// The unit eigenvector of a simple eigenvalue: the longest cross product of two rows of A - value.
PC_HD Vector3 separate_eigenvector(const Symmetric3& m, double value) {
  const Vector3 row0{m.xx - value, m.xy, m.xz}, row1{m.xy, m.yy - value, m.yz}, row2{m.xz, m.yz, m.zz - value};
  const Vector3 a = cross(row0, row1), b = cross(row0, row2), c = cross(row1, row2);
  const double aa = dot(a, a), bb = dot(b, b), cc = dot(c, c);
  const bool b_wins = bb > aa;
  const Vector3 ab = choose(b_wins, b, a);
  const double most = b_wins ? bb : aa;
  return unit(choose(cc > most, c, ab));
}

// A unit vector across a unit vector, from the two components that cannot both vanish.
PC_HD Vector3 perpendicular(const Vector3& v) {
  const bool use_x = fabs(v.x) > fabs(v.y) + kRound;
  return unit({use_x ? -v.z : 0.0, use_x ? 0.0 : v.z, use_x ? v.x : -v.y});
}

// The unit vector across `clear` along which the matrix is smallest: a 2x2 problem in the plane of u and v.
PC_HD Vector3 smallest_across(const Symmetric3& m, const Vector3& clear) {
  const Vector3 u = perpendicular(clear), v = cross(clear, u);
  const Vector3 along_u = times(m, u), along_v = times(m, v);
  // The larger axis of [[uu, uv], [uv, vv]] stands at half the angle of (p, q); half-angle formulas, the larger first.
  const double p = dot(u, along_u) - dot(v, along_v), q = 2 * dot(u, along_v);
  const double radius = sqrt(p * p + q * q);
  const bool is_round = radius <= kRound;
  const double safe = is_round ? 1.0 : radius;
  const double main = sqrt((safe + fabs(p)) / (2 * safe)), other = fabs(q) / (2 * safe * main);
  const double cosine = is_round || p >= 0 ? main : other;
  const double sine = (is_round || p >= 0 ? other : main) * (q < 0 ? -1.0 : 1.0);
  const double c = is_round ? 1.0 : cosine, s = is_round ? 0.0 : sine;
  return {c * v.x - s * u.x, c * v.y - s * u.y, c * v.z - s * u.z};
}

// The unit eigenvector of the smallest eigenvalue. The eigenvalue that stands clear of the other two gives its vector;
// where that is the largest, the smallest is found in the plane across it. Where none stands out: as the reference
// says.
PC_HD Vector3 smallest_eigenvector(const Symmetric3& a) {
  const double scale =
      larger(larger(larger(fabs(a.xx), fabs(a.xy)), larger(fabs(a.xz), fabs(a.yy))), larger(fabs(a.yz), fabs(a.zz)));
  const double divisor = scale > 0 ? scale : 1.0;
  const Symmetric3 m{a.xx / divisor, a.xy / divisor, a.xz / divisor, a.yy / divisor, a.yz / divisor, a.zz / divisor};
  const double mean = (m.xx + m.yy + m.zz) / 3;
  const double dx = m.xx - mean, dy = m.yy - mean, dz = m.zz - mean;
  const double off = m.xy * m.xy + m.xz * m.xz + m.yz * m.yz;
  const double spread = sqrt((dx * dx + dy * dy + dz * dz + 2 * off) / 6);
  const bool is_isotropic = spread <= kRound;
  const double safe = is_isotropic ? 1.0 : spread;
  const double determinant =
      dx * (dy * dz - m.yz * m.yz) - m.xy * (m.xy * dz - m.yz * m.xz) + m.xz * (m.xy * m.yz - dy * m.xz);
  const double half = determinant / (safe * safe * safe) / 2;
  const bool clear_is_largest = half >= 0;
  const double size = fabs(half), clamped = size < 1 ? size : 1.0;
  // The smallest eigenvalue of a matrix is minus the largest of its negative: one cubic serves both.
  const double value = mean + (clear_is_largest ? 2.0 : -2.0) * spread * cosine_of_third(clamped);
  const Vector3 clear = separate_eigenvector(m, value);
  const Vector3 normal = choose(clear_is_largest, smallest_across(m, clear), clear);
  return choose(is_isotropic, {0.0, 0.0, 1.0}, normal);
}

// Turned so that the last component that is not 0 is positive; adding 0 turns -0 into 0.
PC_HD Vector3 positive_last(const Vector3& v) {
  const double leading = v.z != 0 ? v.z : v.y != 0 ? v.y : v.x;
  const double sign = leading < 0 ? -1.0 : 1.0;
  return {sign * v.x + 0.0, sign * v.y + 0.0, sign * v.z + 0.0};
}

// Fewer than three neighbors span no plane.
PC_HD Vector3 normal_of(const Moments& m) {
  const Vector3 normal = smallest_eigenvector(covariance(m));
  return positive_last(choose(m.count < 3, {0.0, 0.0, 1.0}, normal));
}

}  // namespace pc::math
