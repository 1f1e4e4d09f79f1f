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

// A lens that bends the angle off axis: theta (1 + k1 theta^2 + ...).
struct BentAngle {
  double k1, k2, k3, k4;

  double bent(double theta) const {
    const double t = theta * theta;
    return theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4))));
  }
  double slope(double theta) const {
    const double t = theta * theta;
    return 1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * (9 * k4))));
  }
};

// The tangent of 0 to just below a quarter turn, to 5e-16 of it, with the operations of the reference: Cephes, tan.
double tangent(double theta) {
  constexpr double kEighth = 0.78539816339744830962, kQuarter = 1.57079632679489661923, kRest = 6.123233995736766e-17;
  const bool far = theta > kEighth;
  const double x = far ? (theta - kQuarter) - kRest : theta;
  const double z = x * x;
  const double above = (-1.30936939181383734205e4 * z + 1.15351664838587416140e6) * z + -1.79565251976484877988e7;
  const double below =
      (((z + 1.36812963470692954678e4) * z + -1.32089234440210967447e6) * z + 2.50083801823357915839e7) * z +
      -5.38695755929454629881e7;
  const double near = x + x * (z * above / below);
  return far ? -1.0 / near : near;
}

// Rays (x, y) that are bent to `count` coordinates, NaN where there are none up to the largest angle: by Newton's
// method for the angle, between bounds that close in.
void unbend_fisheye(const BentAngle& lens, int64_t count, double largest, int64_t steps, double converged,
                    const double* bent, double* solved) {
  constexpr double kLeast = 1e-20;  // of squared radii: nearer to the axis nothing is bent
  double radius[kBlock], goal[kBlock], theta[kBlock], low[kBlock], high[kBlock];
  int64_t open[kBlock];
  const double farthest = lens.bent(largest);
  for (int64_t i = 0; i < kBlock; ++i) {
    const double x = i < count ? bent[2 * i] : 0.0, y = i < count ? bent[2 * i + 1] : 0.0;
    const double squared = x * x + y * y;
    radius[i] = std::sqrt(squared < kLeast ? kLeast : squared);
    goal[i] = radius[i] <= farthest ? radius[i] : 0.0;
    theta[i] = goal[i] < largest ? goal[i] : largest;
    low[i] = 0;
    high[i] = largest;
    open[i] = 1;
  }
  int64_t any = 1;
  for (int64_t step = 0; step < steps && any != 0; ++step) {
    any = 0;
    for (int64_t i = 0; i < kBlock; ++i) {
      const double error = lens.bent(theta[i]) - goal[i];
      low[i] = error < 0 ? theta[i] : low[i];
      high[i] = error > 0 ? theta[i] : high[i];
      const double next = theta[i] - error / lens.slope(theta[i]);
      const double moved = (next > low[i]) & (next < high[i]) ? next : (low[i] + high[i]) / 2;
      open[i] &= static_cast<int64_t>(std::fabs(error) > converged) & static_cast<int64_t>(moved != theta[i]);
      theta[i] = open[i] ? moved : theta[i];
      any |= open[i];
    }
  }
  for (int64_t i = 0; i < kBlock; ++i) theta[i] = tangent(theta[i]) / radius[i];
  for (int64_t i = 0; i < count; ++i) {
    const bool seen = radius[i] <= farthest;
    solved[2 * i] = seen ? bent[2 * i] * theta[i] : std::nan("");
    solved[2 * i + 1] = seen ? bent[2 * i + 1] * theta[i] : std::nan("");
  }
}

}  // namespace
}  // namespace pc::lenses

PC_EXPORT int32_t pc_unbend_fisheye(const pc_context* context, const double* bent, int64_t count,
                                    const double* coefficients, double largest, int64_t steps, double converged,
                                    double* solved) {
  using namespace pc;
  using namespace pc::lenses;
  return guarded([&] {
    const BentAngle lens{coefficients[0], coefficients[1], coefficients[2], coefficients[3]};
    parallel_for(*context, count, kPerPiece, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t at = begin; at < end; at += kBlock)
        unbend_fisheye(lens, std::min(kBlock, end - at), largest, steps, converged, bent + 2 * at, solved + 2 * at);
    });
  });
}

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
