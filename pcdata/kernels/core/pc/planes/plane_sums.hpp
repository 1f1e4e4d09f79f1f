// Distances of many points to many planes, and the sums a least-squares plane is made of.
#pragma once

#include <limits>

#include "pc/math/plane.hpp"
#include "pc/simd.hpp"

namespace pc::planes {

using math::Plane;

// A block of points as one array per coordinate, small enough for the L1 cache beside everything else.
struct PointBlock {
  static constexpr int kSize = 1024;

  alignas(64) float x[kSize], y[kSize], z[kSize];
  int count = 0;

  // Filled up with points that no plane is near.
  void read(const float* points, int64_t begin, int64_t end) {
    count = static_cast<int>(end - begin);
    for (int i = 0; i < count; ++i) {
      x[i] = points[3 * (begin + i)];
      y[i] = points[3 * (begin + i) + 1];
      z[i] = points[3 * (begin + i) + 2];
    }
    const int whole = (count + kLanes - 1) / kLanes * kLanes;
    for (int i = count; i < whole; ++i) x[i] = y[i] = z[i] = std::numeric_limits<float>::quiet_NaN();
  }
};

inline FloatRegister magnitude(const FloatRegister& value) {
  return reinterpret_cast<FloatRegister>(reinterpret_cast<Int32Register>(value) & 0x7FFFFFFF);
}

// nx*x + ny*y + nz*z + d, in separate float operations like the reference.
inline FloatRegister offset_from(const Plane& plane, const FloatRegister& x, const FloatRegister& y,
                                 const FloatRegister& z) {
  return ((plane.x * x + plane.y * y) + plane.z * z) + plane.d;
}

// Lanes of ones where |((nx*x + ny*y) + nz*z) + d| < distance.
inline Int32Register is_near(const Plane& plane, float distance, const FloatRegister& x, const FloatRegister& y,
                             const FloatRegister& z) {
  return magnitude(offset_from(plane, x, y, z)) < distance;
}

// Add to counts[h] the points of a block near planes[h]. Several planes share each load of a point.
template <int kTogether>
inline void count_near(const PointBlock& block, const Plane* planes, float distance, int64_t* counts) {
  Int32Register near[kTogether] = {};
  for (int i = 0; i < block.count; i += kLanes) {
    const auto x = load<FloatRegister>(block.x + i), y = load<FloatRegister>(block.y + i),
               z = load<FloatRegister>(block.z + i);
    // A true lane is -1.
    for (int h = 0; h < kTogether; ++h) near[h] -= is_near(planes[h], distance, x, y, z);
  }
  for (int h = 0; h < kTogether; ++h) counts[h] += sum_of_lanes(near[h]);
}

// The same of any number of planes: four times four coefficients fit 32 registers.
inline void count_near_all(const PointBlock& block, const Plane* planes, int64_t num_planes, float distance,
                           int64_t* counts) {
  int64_t h = 0;
  for (; h + 4 <= num_planes; h += 4) count_near<4>(block, planes + h, distance, counts + h);
  for (; h < num_planes; ++h) count_near<1>(block, planes + h, distance, counts + h);
}

typedef double Double8 __attribute__((vector_size(64)));
typedef float Float8 __attribute__((vector_size(32)));
typedef int64_t Long8 __attribute__((vector_size(64)));

// Sums over chosen points about a center, each in eight lanes so that every instruction set adds in the same order.
struct PlaneMoments {
  Double8 x{}, y{}, z{}, xx{}, xy{}, xz{}, yy{}, yz{}, zz{};

  void add(const Double8& px, const Double8& py, const Double8& pz) {
    x += px;
    y += py;
    z += pz;
    xx += px * px;
    xy += px * py;
    xz += px * pz;
    yy += py * py;
    yz += py * pz;
    zz += pz * pz;
  }
};

}  // namespace pc::planes
