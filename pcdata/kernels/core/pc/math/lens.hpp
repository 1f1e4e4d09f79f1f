// OpenCV's lens model in float64, with the operations of the reference in their order.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

struct Lens {
  double k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4;
  double fold;  // the radius at which the model folds back

  PC_HD static double cubic(double t, double a, double b, double c) { return 1 + t * (a + t * (b + t * c)); }

  PC_HD bool within_fold(float fx, float fy) const {
    const double x = fx, y = fy;
    return sqrt(x * x + y * y) < fold;
  }
  PC_HD void bend(float& fx, float& fy) const {
    const double x = fx, y = fy, r2 = x * x + y * y;
    const double radial = cubic(r2, k1, k2, k3) / cubic(r2, k4, k5, k6);
    fx = static_cast<float>(((x * radial + 2 * p1 * x * y) + p2 * (r2 + 2 * x * x)) + (s1 + s2 * r2) * r2);
    fy = static_cast<float>(((y * radial + p1 * (r2 + 2 * y * y)) + 2 * p2 * x * y) + (s3 + s4 * r2) * r2);
  }
};

}  // namespace pc::math
