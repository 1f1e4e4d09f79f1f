// Random motions of clouds, and the way back through motions: those of pcdata/functional/motions.py, bit for bit.
#include <cmath>
#include <cstring>

#include "pc/math/random.hpp"
#include "pc/threads.hpp"

namespace pc::motions {
namespace {

enum Kind { kEntry, kSign, kTurn };

constexpr double kPlainDeterminant = 1e-3, kLeastLength = 1e-50, kMostLength = 1e50;

// 1, -1/3!, 1/5!, ... and 1, -1/2!, 1/4!, ...
constexpr double kSine[] = {1.0,
                            -1.0 / 6,
                            1.0 / 120,
                            -1.0 / 5040,
                            1.0 / 362880,
                            -1.0 / 39916800,
                            1.0 / 6227020800,
                            -1.0 / 1307674368000,
                            1.0 / 355687428096000};
constexpr double kCosine[] = {1.0,
                              -1.0 / 2,
                              1.0 / 24,
                              -1.0 / 720,
                              1.0 / 40320,
                              -1.0 / 3628800,
                              1.0 / 479001600,
                              -1.0 / 87178291200,
                              1.0 / 20922789888000,
                              -1.0 / 6402373705728000};
constexpr double kQuarter = 1.57079632673412561417e+00, kQuarterRest = 6.07710050650619224932e-11;
constexpr double kQuarters = 0.63661977236758134308;

template <int kCount>
double polynomial(const double (&coefficients)[kCount], double x) {
  double value = coefficients[kCount - 1];
  for (int i = kCount - 2; i >= 0; --i) value = value * x + coefficients[i];
  return value;
}

// linear (3 rows of a 4x4) = the rotation about a unit axis times linear.
void turn(double* matrix, const double* axis, double angle) {
  const double quarter = std::nearbyint(angle * kQuarters);
  const double rest_angle = (angle - quarter * kQuarter) - quarter * kQuarterRest;
  const double squared = rest_angle * rest_angle;
  const double near_sine = polynomial(kSine, squared) * rest_angle, near_cosine = polynomial(kCosine, squared);
  const auto turns = static_cast<int64_t>(quarter);
  const bool odd = (turns & 1) != 0, far = (turns & 2) != 0;
  double sine = odd ? near_cosine : near_sine, cosine = odd ? near_sine : near_cosine;
  if (far) sine = -sine;
  if (far != odd) cosine = -cosine;

  const double x = axis[0], y = axis[1], z = axis[2], rest = 1.0 - cosine;
  const double cross[3][3] = {{0.0, -z, y}, {z, 0.0, -x}, {-y, x, 0.0}};
  const double square[3][3] = {
      {-(y * y + z * z), x * y, x * z}, {x * y, -(x * x + z * z), y * z}, {x * z, y * z, -(x * x + y * y)}};
  double rotation[3][3], before[3][3];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      rotation[i][j] = ((i == j ? 1.0 : 0.0) + sine * cross[i][j]) + rest * square[i][j];
      before[i][j] = matrix[4 * i + j];
    }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      matrix[4 * i + j] =
          (rotation[i][0] * before[0][j] + rotation[i][1] * before[1][j]) + rotation[i][2] * before[2][j];
}

// The linear part of a 4x4: its largest entry, and what it is times that.
struct Linear {
  double largest = 0.0, cofactors[3][3], determinant;

  explicit Linear(const double* matrix) {
    double m[3][3];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) largest = std::max(largest, std::abs(matrix[4 * i + j]));
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) m[i][j] = matrix[4 * i + j] / largest;
    const double a = m[0][0], b = m[0][1], c = m[0][2], d = m[1][0], e = m[1][1], f = m[1][2], g = m[2][0], h = m[2][1],
                 i = m[2][2];
    const double adjugate[3][3] = {{e * i - f * h, c * h - b * i, b * f - c * e},
                                   {f * g - d * i, a * i - c * g, c * d - a * f},
                                   {d * h - e * g, b * g - a * h, a * e - b * d}};
    std::memcpy(cofactors, adjugate, sizeof cofactors);
    determinant = (a * cofactors[0][0] + b * cofactors[1][0]) + c * cofactors[2][0];
  }
  bool is_plain() const { return std::abs(determinant) >= kPlainDeterminant; }  // not of NaN
};

bool is_plain_motion(const double* matrix) {
  for (int i = 0; i < 12; ++i)
    if (!std::isfinite(matrix[i])) return false;
  if (matrix[12] != 0 || matrix[13] != 0 || matrix[14] != 0 || matrix[15] != 1) return false;
  const Linear linear(matrix);
  return linear.largest >= kLeastLength && linear.largest <= kMostLength && linear.is_plain();
}

}  // namespace
}  // namespace pc::motions

PC_EXPORT int32_t pc_draw_motions(const pc_context*, const int64_t* keys, int64_t num_clouds, const double* draws,
                                  int64_t num_draws, int64_t num_steps, double* matrices) {
  using namespace pc;
  using namespace pc::motions;
  return guarded([&] {
    std::memset(matrices, 0, static_cast<size_t>(16 * num_steps * num_clouds) * sizeof(double));
    for (int64_t at = 0; at < num_steps * num_clouds; ++at)
      for (int i = 0; i < 4; ++i) matrices[16 * at + 5 * i] = 1.0;
    for (int64_t number = 0; number < num_draws; ++number) {
      const double* draw = draws + 8 * number;
      const auto word = static_cast<uint64_t>(draw[1]);
      const double low = draw[3], high = draw[4];
      for (int64_t cloud = 0; cloud < num_clouds; ++cloud) {
        double* matrix = matrices + 16 * (static_cast<int64_t>(draw[0]) * num_clouds + cloud);
        const uint64_t drawn = math::random_word(static_cast<uint64_t>(keys[cloud]), word) >> 11;
        const double unit = static_cast<double>(drawn) * 0x1p-53;
        const double value = low + (high - low) * unit;
        switch (static_cast<Kind>(static_cast<int>(draw[2]))) {
          case kEntry:
            matrix[4 * static_cast<int>(draw[5]) + static_cast<int>(draw[6])] = value;
            break;
          case kSign:
            matrix[5 * static_cast<int>(draw[5])] = unit < low ? -1.0 : 1.0;
            break;
          case kTurn:
            turn(matrix, draw + 5, value);
            break;
        }
      }
    }
  });
}

PC_EXPORT int32_t pc_led_back(const pc_context*, const double* matrices, int64_t num_steps, int64_t num_clouds,
                              const double* source_from_cloud, double* result, int64_t* possible) {
  using namespace pc;
  using namespace pc::motions;
  return guarded([&] {
    *possible = 1;
    std::memcpy(result, source_from_cloud, static_cast<size_t>(16 * num_clouds) * sizeof(double));
    for (int64_t step = 0; step < num_steps; ++step)
      for (int64_t cloud = 0; cloud < num_clouds; ++cloud) {
        const double* matrix = matrices + 16 * (step * num_clouds + cloud);
        const Linear linear(matrix);
        if (!linear.is_plain()) {
          *possible = 0;
          return;
        }
        double inverse[3][3];
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) inverse[i][j] = linear.cofactors[i][j] / linear.determinant / linear.largest;
        for (int i = 0; i < 4; ++i) {
          double *row = result + 16 * cloud + 4 * i, turned[3];
          for (int j = 0; j < 3; ++j)
            turned[j] = (row[0] * inverse[0][j] + row[1] * inverse[1][j]) + row[2] * inverse[2][j];
          row[3] -= (turned[0] * matrix[3] + turned[1] * matrix[7]) + turned[2] * matrix[11];
          std::memcpy(row, turned, sizeof turned);
        }
      }
  });
}

PC_EXPORT int32_t pc_are_plain_motions(const pc_context*, const double* matrices, int64_t count, int64_t* plain) {
  using namespace pc;
  return guarded([&] {
    *plain = 1;
    for (int64_t at = 0; at < count && *plain != 0; ++at) *plain = motions::is_plain_motion(matrices + 16 * at);
  });
}
