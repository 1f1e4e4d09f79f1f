// Points under affine maps, in float64 with one order of operations, and inside a box.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

struct Point {
  float x, y, z;
};

// Where a pixel looks: x/z and y/z.
struct Ray {
  float x, y;
};

PC_HD bool is_finite(Point p) { return (p.x * 0 + p.y * 0) + p.z * 0 == 0; }  // 0 * inf and 0 * NaN are NaN

// The upper three rows of a 4x4 matrix that acts on column vectors.
struct Affine {
  double m[12];

  PC_HD explicit Affine(const double* matrix) {
    for (int i = 0; i < 12; ++i) m[i] = matrix[i];
  }
  PC_HD Point operator()(Point p) const {
    const double x = p.x, y = p.y, z = p.z;
    return {static_cast<float>(((x * m[0] + y * m[1]) + z * m[2]) + m[3]),
            static_cast<float>(((x * m[4] + y * m[5]) + z * m[6]) + m[7]),
            static_cast<float>(((x * m[8] + y * m[9]) + z * m[10]) + m[11])};
  }
};

// A box to crop to, its faces parallel to the axes and part of it.
struct CropBox {
  float lower[3], upper[3];

  PC_HD bool contains(Point p) const {
    return (p.x >= lower[0]) & (p.x <= upper[0]) & (p.y >= lower[1]) & (p.y <= upper[1]) & (p.z >= lower[2]) &
           (p.z <= upper[2]);
  }
};

}  // namespace pc::math
