// The polynomial lens models in float64, with the operations of the reference in their order.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

// OpenCV's twelve coefficients without tilt; or RealSense's inverse Brown-Conrady, where p1 and p2 act on what the
// radial part has bent.
struct Lens {
  double k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4;
  double after;  // not 0: inverse Brown-Conrady
  double fold;   // the radius at which the model folds back

  PC_HD static double cubic(double t, double a, double b, double c) { return 1 + t * (a + t * (b + t * c)); }

  PC_HD bool within_fold(float fx, float fy) const {
    const double x = fx, y = fy;
    return sqrt(x * x + y * y) < fold;
  }
  PC_HD void bend(double& x, double& y) const {
    const double r2 = x * x + y * y;
    const double radial = cubic(r2, k1, k2, k3) / cubic(r2, k4, k5, k6);
    if (after != 0) {
      const double a = x * radial, b = y * radial;
      x = (a + 2 * p1 * a * b) + p2 * (r2 + 2 * a * a);
      y = (b + 2 * p2 * a * b) + p1 * (r2 + 2 * b * b);
      return;
    }
    const double bent_x = ((x * radial + 2 * p1 * x * y) + p2 * (r2 + 2 * x * x)) + (s1 + s2 * r2) * r2;
    y = ((y * radial + p1 * (r2 + 2 * y * y)) + 2 * p2 * x * y) + (s3 + s4 * r2) * r2;
    x = bent_x;
  }
  // d(bent x)/dx, d(bent x)/dy, d(bent y)/dx, d(bent y)/dy.
  struct Jacobian {
    double xx, xy, yx, yy;
  };

  PC_HD static double cubic_slope(double t, double a, double b, double c) { return a + t * (2 * b + t * (3 * c)); }

  PC_HD Jacobian jacobian(double x, double y) const {
    const double r2 = x * x + y * y, denominator = cubic(r2, k4, k5, k6);
    const double radial = cubic(r2, k1, k2, k3) / denominator;
    const double slope = (cubic_slope(r2, k1, k2, k3) - radial * cubic_slope(r2, k4, k5, k6)) / denominator;
    if (after != 0) {
      const double a = x * radial, b = y * radial;
      const double ax = radial + 2 * x * x * slope, both = 2 * x * y * slope, by = radial + 2 * y * y * slope;
      const double x_of_a = (1 + 2 * p1 * b) + 4 * p2 * a, x_of_b = 2 * p1 * a;
      const double y_of_a = 2 * p2 * b, y_of_b = (1 + 2 * p2 * a) + 4 * p1 * b;
      return {(x_of_a * ax + x_of_b * both) + 2 * x * p2, (x_of_a * both + x_of_b * by) + 2 * y * p2,
              (y_of_a * ax + y_of_b * both) + 2 * x * p1, (y_of_a * both + y_of_b * by) + 2 * y * p1};
    }
    const double prism_x = s1 + 2 * s2 * r2, prism_y = s3 + 2 * s4 * r2;
    const double mixed = 2 * ((x * y * slope + p1 * x) + p2 * y);
    return {(((radial + 2 * x * x * slope) + 2 * p1 * y) + 6 * p2 * x) + 2 * x * prism_x, mixed + 2 * y * prism_x,
            mixed + 2 * x * prism_y, (((radial + 2 * y * y * slope) + 6 * p1 * y) + 2 * p2 * x) + 2 * y * prism_y};
  }

  PC_HD void bend(float& fx, float& fy) const {
    double x = fx, y = fy;
    bend(x, y);
    fx = static_cast<float>(x);
    fy = static_cast<float>(y);
  }
};

}  // namespace pc::math
