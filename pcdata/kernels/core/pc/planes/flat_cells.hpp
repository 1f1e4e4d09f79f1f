// A plane's own directions, and square cells in it.
#pragma once

#include <cmath>

#include "pc/math/vector.hpp"
#include "pc/planes/plane_sums.hpp"

namespace pc::planes {

// Two directions in a plane, the first across its normal's least component, in the order of operations of the
// reference.
struct PlaneAxes {
  double down[3], right[3];

  explicit PlaneAxes(const double* n) {
    const double x = std::fabs(n[0]), y = std::fabs(n[1]), z = std::fabs(n[2]);
    const math::Vector3 across = x <= y && x <= z ? math::Vector3{0, n[2], -n[1]}
                                 : y <= z         ? math::Vector3{-n[2], 0, n[0]}
                                                  : math::Vector3{n[1], -n[0], 0};
    const double length = std::sqrt((across.x * across.x + across.y * across.y) + across.z * across.z);
    down[0] = across.x / length, down[1] = across.y / length, down[2] = across.z / length;
    for (int k = 0; k < 3; ++k) {
      const int next = (k + 1) % 3, last = (k + 2) % 3;
      right[k] = n[next] * down[last] - n[last] * down[next];
    }
  }

  double along_down(const float* p) const { return (p[0] * down[0] + p[1] * down[1]) + p[2] * down[2]; }
  double along_right(const float* p) const { return (p[0] * right[0] + p[1] * right[1]) + p[2] * right[2]; }
};

struct Axis {
  float x, y, z;

  explicit Axis(const double* from)
      : x(static_cast<float>(from[0])), y(static_cast<float>(from[1])), z(static_cast<float>(from[2])) {}
  float along(const float* p) const { return (p[0] * x + p[1] * y) + p[2] * z; }
  FloatRegister along(const FloatRegister& px, const FloatRegister& py, const FloatRegister& pz) const {
    return (px * x + py * y) + pz * z;
  }
};

// Cells along one direction: where they begin, how many there are, and how many to a metre.
struct CellsAlong {
  float low, scale;
  int64_t count;

  // Two cells lie before `low`; the first and the last hold all that is farther away.
  Int32Register of(const FloatRegister& along) const {
    const FloatRegister none = {}, from = (along - low) * scale;
    const FloatRegister held = minimum(maximum(from, none - 2), none + static_cast<float>(count));
    const Int32Register place = floored(held) + 2, last = Int32Register{} + static_cast<int32_t>(count - 1);
    return select(less(last, place), last, place);
  }
};

// Cells of a plane, numbered row by row.
struct FlatCells {
  CellsAlong rows, columns;

  Int32Register of(const FloatRegister& down, const FloatRegister& right) const {
    return rows.of(down) * static_cast<int32_t>(columns.count) + columns.of(right);
  }
  int64_t size() const { return rows.count * columns.count; }
};

}  // namespace pc::planes
