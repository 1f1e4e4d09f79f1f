// Distances as every backend computes them.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

// ((dx*dx)+(dy*dy))+(dz*dz) in float, never fused.
PC_HD float squared_distance(float ax, float ay, float az, float bx, float by, float bz) {
  const float dx = ax - bx, dy = ay - by, dz = az - bz;
#if defined(__CUDA_ARCH__)
  return __fadd_rn(__fadd_rn(__fmul_rn(dx, dx), __fmul_rn(dy, dy)), __fmul_rn(dz, dz));
#else
  return ((dx * dx) + (dy * dy)) + (dz * dz);
#endif
}

}  // namespace pc::math
