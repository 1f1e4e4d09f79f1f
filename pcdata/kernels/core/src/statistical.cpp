// Statistical outliers: the mean distance to the nearest neighbors, and which means are unusual for their cloud.
//
// Source: Rusu et al., Toward 3D point cloud based object maps, RAS 2008; edge cases as in Open3D.
#include "pc/neighbors/batch_search.hpp"
#include "pc/neighbors/nearest_keys.hpp"

namespace pc::neighbors {
namespace {

// Writes the mean distance from each query to its k nearest (fewer, in a smaller cloud), summed nearest first.
struct MeanDistance {
  int64_t k;
  double* mean;  // (N,)

  template <class Search, class Nearest>
  void operator()(const Search&, const QueryGroup& group, const Nearest& nearest, const uint32_t* row) const {
    DoublePack total(0.0), found(0.0);
    for (int i = 0; i < k; ++i) {
      const FloatPack squared = nearest.squared(i);
      const PackMask real = less(squared, FloatPack(kInfinity));
      total = total + keep(real, square_root(widen(squared)));
      found = found + keep(real, DoublePack(1.0));
    }
    alignas(64) double value[kQueries];
    (total / found).store(value);
    for (PackMask left = group.active; left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      mean[row[lane]] = value[lane];
    }
  }
};

// The sum of body(0), body(1), ... in eight interleaved runs, then these in order; the reference adds in this order
// too, since the mask hangs on the last bit where all means are equal.
template <class Body>
double interleaved_sum(int64_t count, Body&& body) {
  double run[8] = {};
  int64_t i = 0;
  for (; i + 8 <= count; i += 8)
    for (int lane = 0; lane < 8; ++lane) run[lane] += body(i + lane);
  for (; i < count; ++i) run[i % 8] += body(i);
  double sum = 0;
  for (const double part : run) sum += part;
  return sum;
}

void mark_outliers(const double* mean, int64_t count, double std_ratio, bool* outlier) {
  const double average = interleaved_sum(count, [&](int64_t i) { return mean[i]; }) / double(count);
  const double spread = interleaved_sum(count, [&](int64_t i) {
    const double off = mean[i] - average;
    return mean[i] > 0 ? off * off : 0.0;
  });
  // NaN for one point: every comparison is then false.
  const double threshold = average + std_ratio * std::sqrt(spread / double(count - 1));
  for (int64_t i = 0; i < count; ++i) outlier[i] = !(mean[i] > 0 && mean[i] < threshold);
}

template <class Nearest>
void mean_distances(const pc_context& context, const Clouds& clouds, const Grid* grid, const MeanDistance& task) {
  BatchSearch<Nearest, MeanDistance>(context, task.k, kInfinity, task).run(clouds, grid);
}

}  // namespace
}  // namespace pc::neighbors

PC_EXPORT int32_t pc_statistical_outliers(const pc_context* context, const float* points, const int64_t* ptr,
                                          int64_t num_clouds, int64_t num_neighbors, double std_ratio,
                                          const int64_t* pixel, int64_t width, const double* camera, double* mean,
                                          bool* outlier) {
  using namespace pc;
  using namespace pc::neighbors;
  return guarded([&] {
    const Grid grid{pixel, width, camera};
    const Grid* organized = pixel == nullptr ? nullptr : &grid;
    const MeanDistance task{num_neighbors, mean};
    if (num_neighbors <= NearestDistances::kMax)
      mean_distances<NearestDistances>(*context, {points, ptr, num_clouds}, organized, task);
    else
      mean_distances<NearestMany>(*context, {points, ptr, num_clouds}, organized, task);
    parallel_for(*context, num_clouds, 1, [&](int64_t b, int64_t, int64_t) {
      mark_outliers(mean + ptr[b], ptr[b + 1] - ptr[b], std_ratio, outlier + ptr[b]);
    });
  });
}
