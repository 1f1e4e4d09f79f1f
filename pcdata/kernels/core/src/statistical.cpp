// Statistical outliers: the mean distance to the nearest neighbors, and which means are unusual for their cloud.
//
// Source: Rusu et al., Toward 3D point cloud based object maps, RAS 2008; edge cases as in Open3D.
#include <cmath>

#include "pc/cells/lattice.hpp"
#include "pc/neighbors/nearest_keys.hpp"
#include "pc/neighbors/window_distances.hpp"
#include "pc/rows/kept.hpp"

namespace pc::neighbors {
namespace {

// Sums of float32 distances in double are exact, so that their order does not matter, where the farthest is at most
// 2^20 times the nearest: with up to 2^8 of them, the last bit of the least is worth at least 2^-53 of the sum. Of
// squared distances.
constexpr float kExactRange = int64_t{1} << 40;
constexpr int kMost = NearestDistances::kMax;

// The mean of so many distances, summed nearest first.
double ordered_mean(float* squared, int count) {
  std::sort(squared, squared + count);
  double total = 0;
  int found = 0;
  for (; found < count && squared[found] < kInfinity; ++found) total += double{std::sqrt(squared[found])};
  return total / found;
}

// Writes the mean distance from each query to its k nearest (fewer, in a smaller cloud), summed nearest first or as if.
struct MeanDistance {
  int64_t k;
  double* mean;  // (N,)

  template <class Search, class Nearest>
  void operator()(const Search&, const QueryGroup& group, const Nearest& nearest, const uint32_t* row) const {
    DoublePack total(0.0), found(0.0);
    for (int i = 0; i < k; ++i) {
      const FloatPack squared = nearest.squared(i);
      const PackMask real = less(squared, FloatPack(kInfinity));
      total = total + keep(real, widen(square_root(squared)));
      found = found + keep(real, DoublePack(1.0));
    }
    write(total / found, group.active, row);
  }

  // Of a list of squared distances, the query itself left out.
  template <int kBlocks>
  void operator()(const WindowList<kBlocks>& list, PackMask lanes, const uint32_t* row) const {
    const Row* squared = list.squared();
    DoublePack total(0.0);
    for (int i = 0; i < k - 1; ++i) total = total + widen(square_root(FloatPack::load(squared[i])));
    write(total / DoublePack(static_cast<double>(k)), lanes, row);
    // Copies at distance 0 are as rare as distances of such a range, or too large for a float.
    const PackMask exact =
        less_equal(list.bound(), list.least() * FloatPack(kExactRange)) & less(list.bound(), FloatPack(kInfinity));
    for (PackMask left = lanes & ~exact; left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      float own[kMost] = {};  // the first is the query itself
      for (int i = 0; i < k - 1; ++i) own[i + 1] = squared[i][lane];
      mean[row[lane]] = ordered_mean(own, static_cast<int>(k));
    }
  }

 private:
  void write(const DoublePack& means, PackMask lanes, const uint32_t* row) const {
    alignas(64) double value[kQueries];
    means.store(value);
    for (PackMask left = lanes; left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      mean[row[lane]] = value[lane];
    }
  }
};

// The sum of body(0), body(1), ... in interleaved runs, halves of which are then added to each other; the reference
// adds in this order too, since the mask hangs on the last bit where all means are equal.
template <class Body>
double interleaved_sum(const pc_context& context, int64_t count, Body&& body) {
  constexpr int64_t kRuns = 1024, kRunsPerPiece = 256;
  const int64_t runs = std::min(count, kRuns);  // the others are 0, and adding 0 changes nothing
  double run[kRuns];
  parallel_for(context, runs, kRunsPerPiece, [&](int64_t first, int64_t last, int64_t) {
    double own[kRunsPerPiece] = {};
    for (int64_t start = first; start < count; start += kRuns) {
      const int64_t some = std::min(last - first, count - start);
      for (int64_t i = 0; i < some; ++i) own[i] += body(start + i);
    }
    std::copy_n(own, last - first, run + first);
  });
  for (int64_t half = kRuns / 2; half > 0; half /= 2)
    for (int64_t lane = 0; lane < std::min(half, runs - half); ++lane) run[lane] += run[lane + half];
  return runs > 0 ? run[0] : 0.0;
}

void mark_outliers(const pc_context& context, const double* mean, int64_t count, double std_ratio, bool* outlier) {
  const double average = interleaved_sum(context, count, [&](int64_t i) { return mean[i]; }) / double(count);
  const double spread = interleaved_sum(context, count, [&](int64_t i) {
    const double off = mean[i] - average;
    return mean[i] > 0 ? off * off : 0.0;
  });
  // NaN for one point: every comparison is then false.
  const double threshold = average + std_ratio * std::sqrt(spread / double(count - 1));
  constexpr int64_t kPiece = 1 << 14;
  parallel_for(context, count, kPiece, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t i = begin; i < end; ++i) outlier[i] = !(mean[i] > 0 && mean[i] < threshold);
  });
}

template <class Nearest>
void mean_distances(const pc_context& context, const Clouds& clouds, const MeanDistance& task) {
  BatchSearch<Nearest, MeanDistance>(context, task.k, kInfinity, task).run(clouds, nullptr);
}

// The same for a cloud that lies on a depth image.
void mean_distances(const pc_context& context, const Clouds& clouds, const Grid& grid, int64_t b,
                    const MeanDistance& task) {
  const int64_t begin = clouds.ptr[b], end = clouds.ptr[b + 1], alone[2] = {begin, end};
  const int k = static_cast<int>(task.k);
  ScratchFrame scratch;  // each cloud gets its image in turn: memory is for the largest, not for all
  OrganizedCloud cloud;
  BatchSearch<NearestDistances, MeanDistance> search(context, k, kInfinity, task);
  if (k < 2 ||
      !cloud.build(context, scratch, clouds.points, grid, b, begin, end, WindowDistances<MeanDistance>::max_reach(k)))
    return search.run({clouds.points, alone, 1}, nullptr);
  Unproved* rest = scratch.take<Unproved>(end - begin);
  const int64_t count = WindowDistances<MeanDistance>(cloud, k, task).run(context, scratch, end - begin, rest);
  search.finish(scratch, clouds.points, cloud, begin, end, rest, count);
}

}  // namespace
}  // namespace pc::neighbors

PC_EXPORT int32_t pc_statistical_outliers(const pc_context* context, const float* points, const int64_t* ptr,
                                          int64_t num_clouds, int64_t num_neighbors, double std_ratio,
                                          const int64_t* pixel, int64_t width, const double* camera, double* mean,
                                          uint8_t* marks, int64_t* kept_ptr, int64_t* sums) {
  using namespace pc;
  using namespace pc::neighbors;
  return guarded([&] {
    ScratchFrame scratch;
    if (mean == nullptr) mean = scratch.take<double>(ptr[num_clouds]);
    const Grid grid{pixel, width, camera};
    const MeanDistance task{num_neighbors, mean};
    const Clouds clouds{points, ptr, num_clouds};
    if (num_neighbors > kMost)
      mean_distances<NearestMany>(*context, clouds, task);
    else if (pixel == nullptr)
      mean_distances<NearestDistances>(*context, clouds, task);
    else
      for (int64_t b = 0; b < num_clouds; ++b) mean_distances(*context, clouds, grid, b, task);
    cells::for_each_cloud(*context, ptr, num_clouds, [&](const pc_context& own, int64_t first, int64_t count) {
      // As truth values: bytes may lie anywhere, so each store would let the compiler read the means anew.
      mark_outliers(own, mean + first, count, std_ratio, reinterpret_cast<bool*>(marks) + first);
    });
    if (kept_ptr != nullptr) rows::mark_kept(*context, marks, true, nullptr, ptr, num_clouds, {marks, kept_ptr, sums});
  });
}
