// Four numbers of each of four rows, turned into four columns.
#pragma once

#include "pc/simd.hpp"

namespace pc::images {

typedef float Quad __attribute__((vector_size(16)));

inline void transpose(Quad (&rows)[4]) {
#if defined(__SSE2__)
  _MM_TRANSPOSE4_PS(rows[0], rows[1], rows[2], rows[3]);
#elif defined(PC_NEON)
  const float32x4x2_t upper = vtrnq_f32(reinterpret_cast<float32x4_t>(rows[0]), reinterpret_cast<float32x4_t>(rows[1]));
  const float32x4x2_t lower = vtrnq_f32(reinterpret_cast<float32x4_t>(rows[2]), reinterpret_cast<float32x4_t>(rows[3]));
  for (int i = 0; i < 2; ++i) {
    rows[i] = reinterpret_cast<Quad>(vcombine_f32(vget_low_f32(upper.val[i]), vget_low_f32(lower.val[i])));
    rows[i + 2] = reinterpret_cast<Quad>(vcombine_f32(vget_high_f32(upper.val[i]), vget_high_f32(lower.val[i])));
  }
#else
  for (int r = 0; r < 4; ++r)
    for (int c = 0; c < r; ++c) {
      const float below = rows[r][c];
      rows[r][c] = rows[c][r];
      rows[c][r] = below;
    }
#endif
}

}  // namespace pc::images
