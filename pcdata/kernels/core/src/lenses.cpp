// Lenses inverted.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "pc/math/lens.hpp"
#include "pc/threads.hpp"

namespace pc::lenses {
namespace {

constexpr int64_t kBlock = 64;  // coordinates that take their steps together: loops over them vectorize
constexpr int64_t kPerPiece = 64 * kBlock;

// `count` coordinates (x, y), bent in place of those that they come from. Those that have converged take no more steps.
void unbend(const math::Lens lens, int64_t count, int64_t steps, double converged, const double* bent, double* solved) {
  double x[kBlock], y[kBlock], target_x[kBlock], target_y[kBlock];
  bool open[kBlock];
  for (int64_t i = 0; i < count; ++i) {
    x[i] = target_x[i] = bent[2 * i];
    y[i] = target_y[i] = bent[2 * i + 1];
    open[i] = true;
  }
  const double fold = lens.fold, edge = 0.999 * fold;
  bool any = true;
  for (int64_t step = 0; step < steps && any; ++step) {
    any = false;
    for (int64_t i = 0; i < count; ++i) {
      double bent_x = x[i], bent_y = y[i];
      lens.bend(bent_x, bent_y);
      const double error_x = bent_x - target_x[i], error_y = bent_y - target_y[i];
      // Written so that a NaN stays open.
      const bool solves = (std::fabs(error_x) <= converged) & (std::fabs(error_y) <= converged) &
                          (x[i] * x[i] + y[i] * y[i] < fold * fold);
      open[i] = open[i] & !solves;
      const math::Lens::Jacobian j = lens.jacobian(x[i], y[i]);
      const double determinant = j.xx * j.yy - j.xy * j.yx;
      const double new_x = x[i] - (j.yy * error_x - j.xy * error_y) / determinant;
      const double new_y = y[i] - (j.xx * error_y - j.yx * error_x) / determinant;
      // A step over the fold comes back to just inside it; a singular Jacobian (NaN) is left to fail.
      const double r2 = new_x * new_x + new_y * new_y;
      const double shrink = r2 > edge * edge ? edge / std::sqrt(r2) : 1.0;
      x[i] = open[i] ? new_x * shrink : x[i];
      y[i] = open[i] ? new_y * shrink : y[i];
      any |= open[i];
    }
  }
  for (int64_t i = 0; i < count; ++i) {
    solved[2 * i] = open[i] ? std::nan("") : x[i];
    solved[2 * i + 1] = open[i] ? std::nan("") : y[i];
  }
}

}  // namespace
}  // namespace pc::lenses

PC_EXPORT int32_t pc_unbend(const pc_context* context, const double* bent, int64_t count, const double* lens,
                            int64_t steps, double converged, double* solved) {
  using namespace pc;
  using namespace pc::lenses;
  return guarded([&] {
    math::Lens own;
    std::memcpy(&own, lens, sizeof own);
    parallel_for(*context, count, kPerPiece, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t at = begin; at < end; at += kBlock)
        unbend(own, std::min(kBlock, end - at), steps, converged, bent + 2 * at, solved + 2 * at);
    });
  });
}
