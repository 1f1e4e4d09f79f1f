// What this library is and whether the processor runs it.
#include "pc/common.hpp"

// Raised whenever a signature below or in another source changes: Python refuses a library of another number.
PC_EXPORT int32_t pc_interface_version() { return 6; }

// Only meaningful in the baseline library, which runs everywhere: 0 baseline, 1 avx2, 2 avx512.
PC_EXPORT int32_t pc_best_instruction_set() {
#if defined(__x86_64__) && (defined(__GNUC__) || defined(__clang__))
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("bmi2"))
    return 2;
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2")) return 1;
#endif
  return 0;
}
