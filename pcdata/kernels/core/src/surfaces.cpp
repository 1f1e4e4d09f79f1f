// The surface of second order that a table is, fitted by turns with its noise.
#include <cmath>
#include <limits>
#include <vector>

#include "pc/memory.hpp"
#include "pc/simd.hpp"
#include "pc/threads.hpp"

namespace pc::surfaces {
namespace {

constexpr int64_t kPiece = 1 << 13;  // points that a thread takes at once
constexpr int kTerms = 6;            // 1, s, t, s s, s t, t t
constexpr int64_t kBins = 1024;
constexpr int kSumLanes = 8;  // each adds every eighth point, on every processor

typedef double Double8 __attribute__((vector_size(64)));

// As pcdata.functional.surface_fit lays them out.
struct Numbers {
  double distance, step, rounds, own, beside_from, beside_to, mad, least_noise;
};

struct Coefficients {
  double of[kTerms] = {};

  double at(double s, double t) const {
    return ((((of[0] + of[1] * s) + of[2] * t) + of[3] * (s * s)) + of[4] * (s * t)) + of[5] * (t * t);
  }
};

double lower_median(double* values, int64_t count) {
  double* middle = values + (count - 1) / 2;
  std::nth_element(values, middle, values + count);
  return *middle;
}

// Some of the points: the coordinates over the plane, the height, and the weight of each.
struct Sample {
  int64_t count;
  double *s, *t, *height, *weight;  // (count,)
  uint8_t* near;                    // (count,) whether the fit takes it
  double* work;                     // (count,)

  int64_t num_near() const {
    int64_t found = 0;
    for (int64_t i = 0; i < count; ++i) found += near[i];
    return found;
  }
};

// Solve a positive definite system of six by its Cholesky factor; `m` holds the lower triangle.
Coefficients solved(double (*m)[kTerms], double* right) {
  for (int i = 0; i < kTerms; ++i)
    for (int j = 0; j <= i; ++j) {
      double value = m[i][j];
      for (int k = 0; k < j; ++k) value -= m[i][k] * m[j][k];
      m[i][j] = i == j ? std::sqrt(value) : value / m[j][j];
    }
  for (int i = 0; i < kTerms; ++i) {
    for (int k = 0; k < i; ++k) right[i] -= m[i][k] * right[k];
    right[i] /= m[i][i];
  }
  Coefficients found;
  for (int i = kTerms - 1; i >= 0; --i) {
    for (int k = i + 1; k < kTerms; ++k) right[i] -= m[k][i] * found.of[k];
    found.of[i] = right[i] / m[i][i];
  }
  return found;
}

// The surface that fits the heights of the near points best, weighted; see surface_fit of the reference.
Coefficients fitted(const Sample& sample, double sigma, double distance) {
  Double8 products[kTerms * (kTerms + 1) / 2] = {}, moments[kTerms] = {};
  alignas(64) double s[kSumLanes], t[kSumLanes], height[kSumLanes], weight[kSumLanes];
  int filled = 0;
  const auto add = [&] {
    const auto w = load<Double8>(weight), at_s = load<Double8>(s), at_t = load<Double8>(t);
    const Double8 terms[kTerms] = {w, at_s * w, at_t * w, (at_s * at_s) * w, (at_s * at_t) * w, (at_t * at_t) * w};
    const Double8 target = load<Double8>(height) * w;
    int number = 0;
    for (int i = 0; i < kTerms; ++i) {
      for (int j = 0; j <= i; ++j) products[number++] += terms[i] * terms[j];
      moments[i] += terms[i] * target;
    }
    filled = 0;
  };
  for (int64_t i = 0; i < sample.count; ++i) {
    if (!sample.near[i]) continue;
    s[filled] = sample.s[i], t[filled] = sample.t[i], height[filled] = sample.height[i];
    weight[filled++] = sample.weight[i] / sigma;
    if (filled == kSumLanes) add();
  }
  if (filled > 0) {
    for (int i = filled; i < kSumLanes; ++i) s[i] = t[i] = height[i] = weight[i] = 0;
    add();
  }
  const auto sum = [](const Double8& lanes) {
    double total = 0;
    for (int lane = 0; lane < kSumLanes; ++lane) total += lanes[lane];
    return total;
  };
  double m[kTerms][kTerms], right[kTerms];
  int number = 0;
  for (int i = 0; i < kTerms; ++i) {
    for (int j = 0; j <= i; ++j) m[i][j] = sum(products[number++]);
    m[i][i] += (i < 3 ? 1e-6 : 1.0) / (distance * distance);
    right[i] = sum(moments[i]);
  }
  return solved(m, right);
}

// The median distance of a surface's own points, and the share of clutter, as own_spread of the reference.
void own_spread(const Sample& sample, const double* off, double sigma, const Numbers& numbers, double& middle,
                double& clutter) {
  const double first = numbers.beside_from * sigma, last = numbers.beside_to * sigma, own_to = numbers.own * sigma;
  int64_t above = 0, below = 0, count = 0;
  double* near = sample.work;
  for (int64_t i = 0; i < sample.count; ++i) {
    above += (off[i] > first) & (off[i] < last);
    below += (-off[i] > first) & (-off[i] < last);
    const double away = std::fabs(off[i]);
    if (away < own_to) near[count++] = away;
  }
  middle = 0, clutter = 1;
  if (count == 0) return;
  const double density = 2 * std::sqrt(static_cast<double>(above) * static_cast<double>(below)) / (last - first);
  const double own = static_cast<double>(count) - density * own_to;
  if (own < 1) {
    middle = sigma;
    return;
  }
  clutter = 1 - own / static_cast<double>(count);
  // The first of the sorted distances that is reached. Bins are in their order, so only those are sorted that may hold
  // it: the last of a bin comes no later than the bin ends, and is no nearer than it begins.
  const double bins_per_length = kBins / own_to;
  const auto bin_of = [&](double away) { return std::min(static_cast<int64_t>(away * bins_per_length), kBins - 1); };
  int64_t in_bin[kBins] = {}, before = 0;
  for (int64_t i = 0; i < count; ++i) ++in_bin[bin_of(near[i])];
  std::vector<double> some;
  for (int64_t bin = 0; bin < kBins; before += in_bin[bin++]) {
    const double from = static_cast<double>(bin) / bins_per_length * (1 - 1e-12);
    if (in_bin[bin] == 0 || static_cast<double>(before + in_bin[bin]) - density * from < own / 2 * (1 - 1e-12))
      continue;
    some.clear();
    for (int64_t i = 0; i < count; ++i)
      if (bin_of(near[i]) == bin) some.push_back(near[i]);
    std::sort(some.begin(), some.end());
    for (size_t i = 0; i < some.size(); ++i)
      if (static_cast<double>(before + static_cast<int64_t>(i) + 1) - density * some[i] >= own / 2) {
        middle = some[i];
        return;
      }
  }
}

// Scale coordinates of the sample over the span of the near ones to -1..1, level beyond; return what does so.
struct Scaling {
  double lower, half;

  double of(double along) const { return std::clamp((along - lower) / half - 1, -1.0, 1.0); }
};

Scaling scaling(const double* along, const uint8_t* near, int64_t count, double least) {
  double lower = std::numeric_limits<double>::infinity(), upper = -lower;
  for (int64_t i = 0; i < count; ++i)
    if (near[i]) lower = std::min(lower, along[i]), upper = std::max(upper, along[i]);
  return {lower, std::max((upper - lower) / 2, least)};
}

double median_of_near(const Sample& sample, const double* values) {
  int64_t count = 0;
  for (int64_t i = 0; i < sample.count; ++i)
    if (sample.near[i]) sample.work[count++] = values[i];
  return lower_median(sample.work, count);
}

struct Found {
  double noise, typical, clutter, num_near;
};

class Fit {
 public:
  Fit(ScratchFrame& scratch, const Numbers& numbers, int64_t count) : numbers_(numbers) {
    sample_.count = count;
    for (double** values : {&sample_.s, &sample_.t, &sample_.height, &sample_.weight, &sample_.work, &off_, &reach_})
      *values = scratch.take<double>(count);
    sample_.near = scratch.take<uint8_t>(count);
  }

  void set(int64_t i, double s, double t, double height, double reach) {
    sample_.s[i] = s, sample_.t[i] = t, sample_.height[i] = height, sample_.weight[i] = 1 / reach, reach_[i] = reach;
    sample_.near[i] = std::fabs(height) < numbers_.distance;
  }

  // Fit by turns; the surface is over coordinates that `s` and `t` scale.
  Found run(Poll& poll, Scaling& s, Scaling& t, Coefficients& surface) {
    Found found{0, 0, 0, static_cast<double>(sample_.num_near())};
    if (found.num_near < 3) return found;
    s = scaling(sample_.s, sample_.near, sample_.count, numbers_.distance);
    t = scaling(sample_.t, sample_.near, sample_.count, numbers_.distance);
    for (int64_t i = 0; i < sample_.count; ++i) {
      sample_.s[i] = s.of(sample_.s[i]), sample_.t[i] = t.of(sample_.t[i]);
      off_[i] = std::fabs(sample_.height[i]) * sample_.weight[i];
    }
    found.typical = median_of_near(sample_, reach_);
    const double least = numbers_.least_noise * numbers_.distance / found.typical;
    double sigma = std::max(median_of_near(sample_, off_) * numbers_.mad, least);
    for (int round = 0; round < static_cast<int>(numbers_.rounds); ++round) {
      poll.check();
      surface = fitted(sample_, sigma, numbers_.distance);
      for (int64_t i = 0; i < sample_.count; ++i)
        off_[i] = (sample_.height[i] - surface.at(sample_.s[i], sample_.t[i])) * sample_.weight[i];
      const double before = sigma;
      double middle;
      own_spread(sample_, off_, sigma, numbers_, middle, found.clutter);
      sigma = std::max(middle * numbers_.mad, least);
      for (int64_t i = 0; i < sample_.count; ++i) sample_.near[i] = std::fabs(off_[i]) < numbers_.own * sigma;
      if (std::fabs(sigma - before) < 1e-3 * sigma || sample_.num_near() < 3) break;
    }
    found.noise = sigma;
    return found;
  }

 private:
  Sample sample_{};
  Numbers numbers_;
  double *off_, *reach_;
};

}  // namespace
}  // namespace pc::surfaces

PC_EXPORT int32_t pc_reach(const pc_context* context, const float* points, int64_t rows, const double* places,
                           int64_t num_places, double least, double* reach) {
  using namespace pc;
  using namespace pc::surfaces;
  return guarded([&] {
    const int64_t step = num_places == 1 ? 0 : 3;
    parallel_for(*context, rows, kPiece, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i) {
        const double* place = places + step * i;
        const double dx = points[3 * i] - place[0], dy = points[3 * i + 1] - place[1],
                     dz = points[3 * i + 2] - place[2];
        reach[i] = std::max(std::sqrt((dx * dx + dy * dy) + dz * dz), least);
      }
    });
  });
}

PC_EXPORT int32_t pc_fit_surface(const pc_context* context, const float* points, int64_t count, const double* reach,
                                 const double* plane, const double* axes, const double* numbers, double* height,
                                 double* found) {
  using namespace pc;
  using namespace pc::surfaces;
  return guarded([&] {
    ScratchFrame scratch;
    const Numbers& own = *reinterpret_cast<const Numbers*>(numbers);
    const auto step = static_cast<int64_t>(own.step);
    double *s = scratch.take<double>(count), *t = scratch.take<double>(count);
    Fit fit(scratch, own, (count + step - 1) / step);
    parallel_for(*context, count, kPiece, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i) {
        const double x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
        height[i] = ((plane[0] * x + plane[1] * y) + plane[2] * z) + plane[3];
        s[i] = (x * axes[0] + y * axes[2]) + z * axes[4];
        t[i] = (x * axes[1] + y * axes[3]) + z * axes[5];
      }
      for (int64_t i = (begin + step - 1) / step * step; i < end; i += step)
        fit.set(i / step, s[i], t[i], height[i], reach[i]);
    });
    Poll poll(*context);
    Scaling along{}, across{};
    Coefficients surface;
    *reinterpret_cast<Found*>(found) = fit.run(poll, along, across, surface);
    if (found[3] < 3) return;
    parallel_for(*context, count, kPiece, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i) height[i] -= surface.at(along.of(s[i]), across.of(t[i]));
    });
  });
}
