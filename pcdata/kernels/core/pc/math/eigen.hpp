// Eigenvalues and eigenvectors of symmetric 3x3 matrices, to the last digits.
#pragma once

#include "pc/math/normal.hpp"
#include "pc/math/vector.hpp"

namespace pc::math {

struct LeastVarying {
  Vector3 direction;   // unit
  double least, next;  // the eigenvalue of that direction, and the one after it
};

// Turn rows and columns p and q of a matrix so that the element between them vanishes, and with them the columns of v.
PC_HD void turn_pair(double a[3][3], double v[3][3], int p, int q) {
  if (a[p][q] == 0) return;
  const double theta = (a[q][q] - a[p][p]) / (2 * a[p][q]);
  const double size = 1 / (fabs(theta) + sqrt(theta * theta + 1)), t = theta < 0 ? -size : size;
  const double c = 1 / sqrt(t * t + 1), s = t * c, shift = t * a[p][q];
  const int r = 3 - p - q;
  const double rp = a[r][p], rq = a[r][q];
  a[p][p] -= shift;
  a[q][q] += shift;
  a[p][q] = a[q][p] = 0;
  a[r][p] = a[p][r] = c * rp - s * rq;
  a[r][q] = a[q][r] = s * rp + c * rq;
  for (int k = 0; k < 3; ++k) {
    const double kp = v[k][p], kq = v[k][q];
    v[k][p] = c * kp - s * kq;
    v[k][q] = s * kp + c * kq;
  }
}

// The direction in which a covariance varies least; the first of equals. Source: Jacobi's cyclic method as in Golub &
// Van Loan, Matrix Computations, 4th ed., section 8.5: errors are some units in the last place of the matrix.
PC_HD LeastVarying least_varying(const Symmetric3& m) {
  constexpr int kSweeps = 24;  // six are enough: each squares what is left
  constexpr double kNothing = 1e-20;
  double a[3][3] = {{m.xx, m.xy, m.xz}, {m.xy, m.yy, m.yz}, {m.xz, m.yz, m.zz}};
  double v[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  for (int sweep = 0; sweep < kSweeps; ++sweep) {
    const double off = fabs(a[0][1]) + fabs(a[0][2]) + fabs(a[1][2]);
    if (!(off > kNothing * (fabs(a[0][0]) + fabs(a[1][1]) + fabs(a[2][2])))) break;
    turn_pair(a, v, 0, 1);
    turn_pair(a, v, 0, 2);
    turn_pair(a, v, 1, 2);
  }
  int at = 0;
  for (int k = 1; k < 3; ++k)
    if (a[k][k] < a[at][at]) at = k;
  const double others[2] = {a[(at + 1) % 3][(at + 1) % 3], a[(at + 2) % 3][(at + 2) % 3]};
  const double next = others[0] < others[1] ? others[0] : others[1];
  return {unit({v[0][at], v[1][at], v[2][at]}), a[at][at], next};
}

}  // namespace pc::math
