// An affine map of points, in float64 with one order of operations.
#pragma once

namespace pc {

struct Point {
  float x, y, z;
};

// The upper three rows of a 4x4 matrix that acts on column vectors.
struct Affine {
  double m[12];

  explicit Affine(const double* matrix) {
    for (int i = 0; i < 12; ++i) m[i] = matrix[i];
  }
  Point operator()(Point p) const {
    const double x = p.x, y = p.y, z = p.z;
    return {static_cast<float>(((x * m[0] + y * m[1]) + z * m[2]) + m[3]),
            static_cast<float>(((x * m[4] + y * m[5]) + z * m[6]) + m[7]),
            static_cast<float>(((x * m[8] + y * m[9]) + z * m[10]) + m[11])};
  }
};

// A box with its faces, parallel to the axes.
struct Box {
  float lower[3], upper[3];

  bool contains(Point p) const {
    return (p.x >= lower[0]) & (p.x <= upper[0]) & (p.y >= lower[1]) & (p.y <= upper[1]) & (p.z >= lower[2]) &
           (p.z <= upper[2]);
  }
};

inline bool is_finite(Point p) { return (p.x * 0 + p.y * 0) + p.z * 0 == 0; }  // 0 * inf and 0 * NaN are NaN

}  // namespace pc
