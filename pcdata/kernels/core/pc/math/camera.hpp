// A pinhole camera with OpenCV's lens in float64, with the operations of the reference in their order.
#pragma once

#include "pc/math/lens.hpp"

namespace pc::math {

struct Pixel {
  double u, v;
  bool seen;
};

struct PinholeCamera {
  double fx, skew, cx, fy, cy;

  // k (3, 3)
  PC_HD static PinholeCamera of(const double* k) { return {k[0], k[1], k[2], k[4], k[5]}; }

  // Where a point in the camera's frame is seen; the lens may be null.
  PC_HD Pixel pixel(double px, double py, double pz, const Lens* lens) const {
    bool seen = pz > 0;
    const double divisor = seen ? pz : 1.0;
    double x = px / divisor, y = py / divisor;
    if (lens != nullptr) {
      seen = seen & (x * x + y * y < lens->fold * lens->fold);
      x = seen ? x : 0.0;
      y = seen ? y : 0.0;
      lens->bend(x, y);
    }
    return {(fx * x + skew * y) + cx, fy * y + cy, seen};
  }
};

}  // namespace pc::math
