// What lets one header serve g++ and CUDA's compilers, NVRTC among them, which has no standard library: functions of
// this folder are marked PC_HD, work on plain numbers and arrays, and include nothing but one another.
#pragma once

#if defined(__CUDACC__)
#define PC_HD __host__ __device__ __forceinline__
#else
#define PC_HD inline
#endif

#if defined(__CUDACC_RTC__)
namespace pc {
using uint8_t = unsigned char;
using int16_t = short;
using int32_t = int;
using int64_t = long long;
using uint32_t = unsigned int;
using uint64_t = unsigned long long;
}  // namespace pc
#else
#include <cmath>
#include <cstdint>
#endif

namespace pc::math {

PC_HD float float_of_bits(uint32_t bits) {
#if defined(__CUDACC__)
  return __uint_as_float(bits);
#else
  float value;
  __builtin_memcpy(&value, &bits, sizeof value);
  return value;
#endif
}

PC_HD uint32_t bits_of_float(float value) {
#if defined(__CUDACC__)
  return __float_as_uint(value);
#else
  uint32_t bits;
  __builtin_memcpy(&bits, &value, sizeof bits);
  return bits;
#endif
}

PC_HD double larger(double a, double b) { return a > b ? a : b; }

}  // namespace pc::math
