// Per-point arithmetic, device-neutral: included by the CPU core and by CUDA sources alike.
#pragma once

#if defined(__CUDACC__)
#define PC_HD __host__ __device__ __forceinline__
#else
#define PC_HD inline
#endif

namespace pc {

// Squared distance as every backend computes it: ((dx*dx)+(dy*dy))+(dz*dz) in float, never fused.
PC_HD float squared_distance(float ax, float ay, float az, float bx, float by, float bz) {
  const float dx = ax - bx, dy = ay - by, dz = az - bz;
#if defined(__CUDA_ARCH__)
  return __fadd_rn(__fadd_rn(__fmul_rn(dx, dx), __fmul_rn(dy, dy)), __fmul_rn(dz, dz));
#else
  return ((dx * dx) + (dy * dy)) + (dz * dz);
#endif
}

}  // namespace pc
