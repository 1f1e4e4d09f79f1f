// The cells of a plane in which a surface lies: where points near it are no rarer than usual, in large patches.
#include "pc/exports.hpp"
#include "pc/threads.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace pc {
namespace {

constexpr int64_t kMostPoints = 1 << 14, kMostCells = 500, kCrossed = 2, kSmaller = 10;
constexpr int kShareBits = 30;
constexpr double kReach = 5, kCell = 4, kMostLonely = 0.2;

// Places in the plane of points that are looked at; of those near it, and of those that tell whether something crosses.
struct Places {
  std::vector<float> along[2];
  std::vector<uint8_t> own;
  int64_t num_own = 0;

  Places(const float* points, const uint8_t* near, int64_t count, const double* plane, const double* axes,
         double distance) {
    const int64_t stride = std::max<int64_t>(1, count / kMostPoints);
    const auto reach = static_cast<float>(kReach * distance);
    float n[4], down[3], right[3];
    std::transform(plane, plane + 4, n, [](double from) { return static_cast<float>(from); });
    std::transform(axes, axes + 3, down, [](double from) { return static_cast<float>(from); });
    std::transform(axes + 3, axes + 6, right, [](double from) { return static_cast<float>(from); });
    for (int64_t i = 0; i < count; i += stride) {
      const float *p = points + 3 * i, height = ((p[0] * n[0] + p[1] * n[1]) + p[2] * n[2]) + n[3];
      if (!near[i] && !(std::fabs(height) < reach)) continue;
      along[0].push_back((p[0] * down[0] + p[1] * down[1]) + p[2] * down[2]);
      along[1].push_back((p[0] * right[0] + p[1] * right[1]) + p[2] * right[2]);
      own.push_back(near[i]);
      num_own += near[i];
    }
  }
};

// Counts of points in cells, with two empty ones at each end.
struct Counts {
  int64_t size[2];
  std::vector<int32_t> near, all;

  Counts(const Places& places, const float* low, const double* spans, double edge)
      : size{static_cast<int64_t>(spans[0] / edge) + 5, static_cast<int64_t>(spans[1] / edge) + 5},
        near(static_cast<size_t>(size[0] * size[1])),
        all(near.size()) {
    const auto scale = static_cast<float>(1 / edge);
    for (size_t i = 0; i < places.own.size(); ++i) {
      int64_t place[2];
      for (int axis = 0; axis < 2; ++axis) {
        const float from = std::floor((places.along[axis][i] - low[axis]) * scale) + 2;
        place[axis] = static_cast<int64_t>(std::min(std::max(from, 0.0F), static_cast<float>(size[axis] - 1)));
      }
      const auto cell = static_cast<size_t>(place[0] * size[1] + place[1]);
      ++all[cell];
      near[cell] += places.own[i];
    }
  }

  bool sparse() const {
    const auto lonely = std::count(near.begin(), near.end(), 1);
    const auto held = static_cast<int64_t>(near.size()) - std::count(near.begin(), near.end(), 0);
    return !(static_cast<double>(lonely) <= kMostLonely * static_cast<double>(held));
  }

  // Mark the cells in which points near the plane are no rarer than usual.
  void mark_usual(int64_t num_own, uint8_t* cells) const {
    std::vector<int64_t> share(near.size());
    int64_t sum = 0;
    for (size_t i = 0; i < near.size(); ++i) {
      if (near[i] == 0) continue;
      share[i] = (static_cast<int64_t>(near[i]) << kShareBits) / all[i];
      sum += near[i] * share[i];
    }
    for (size_t i = 0; i < near.size(); ++i) cells[i] = near[i] > 0 && share[i] * (kCrossed * num_own) >= sum;
  }
};

// Leave out the patches, connected over corners too, that are small beside the largest. No cell at a rim is marked.
void keep_large(uint8_t* cells, int64_t count, int64_t width) {
  const int64_t around[8] = {-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1};
  std::vector<int64_t> members, ends;
  for (int64_t first = 0; first < count; ++first) {
    if (cells[first] != 1) continue;
    cells[first] = 2;
    members.push_back(first);
    for (size_t next = members.size() - 1; next < members.size(); ++next) {
      for (const int64_t step : around) {
        const int64_t other = members[next] + step;
        if (cells[other] != 1) continue;
        cells[other] = 2;
        members.push_back(other);
      }
    }
    ends.push_back(static_cast<int64_t>(members.size()));
  }
  int64_t largest = 0, begin = 0;
  for (const int64_t end : ends) largest = std::max(largest, end - begin), begin = end;
  begin = 0;
  for (const int64_t end : ends) {
    for (int64_t i = begin; i < end; ++i)
      cells[members[static_cast<size_t>(i)]] = (end - begin) * kSmaller >= largest ? 1 : 0;
    begin = end;
  }
}

// Add the empty cells beside marked ones.
void add_rim(const std::vector<int32_t>& near, int64_t height, int64_t width, uint8_t* cells) {
  const std::vector<uint8_t> marked(cells, cells + height * width);
  for (int64_t row = 1; row + 1 < height; ++row) {
    for (int64_t column = 1; column + 1 < width; ++column) {
      const int64_t cell = row * width + column;
      if (!marked[static_cast<size_t>(cell)]) continue;
      for (int64_t down = -width; down <= width; down += width) {
        for (int64_t other = cell + down - 1; other <= cell + down + 1; ++other)
          cells[other] |= static_cast<uint8_t>(near[static_cast<size_t>(other)] == 0);
      }
    }
  }
}

}  // namespace
}  // namespace pc

PC_EXPORT int32_t pc_patch_cells(const pc_context*, const float* points, const uint8_t* near, int64_t count,
                                 const double* plane, const double* axes, double distance, int64_t* size,
                                 double* numbers, uint8_t* cells) {
  using namespace pc;
  return guarded([&] {
    size[0] = size[1] = 0;
    std::fill_n(numbers, 3, 0.0);
    const Places places(points, near, count, plane, axes, distance);
    if (places.num_own == 0) return;
    float low[2];
    double spans[2];
    for (int axis = 0; axis < 2; ++axis) {
      const auto [least, most] = std::minmax_element(places.along[axis].begin(), places.along[axis].end());
      low[axis] = *least;
      spans[axis] = static_cast<double>(*most - *least);
    }
    const double span = std::max(spans[0], spans[1]);
    double edge = std::max(kCell * distance, span / static_cast<double>(kMostCells));
    if (!(std::isfinite(spans[0]) && std::isfinite(spans[1]) && std::isfinite(static_cast<float>(1 / edge)))) {
      size[0] = size[1] = -1;
      return;
    }
    Counts counts(places, low, spans, edge);
    while (counts.sparse() && !(edge > span / 4)) {
      edge *= 2;
      counts = Counts(places, low, spans, edge);
    }
    std::copy(counts.size, counts.size + 2, size);
    numbers[0] = low[0], numbers[1] = low[1], numbers[2] = 1 / edge;
    counts.mark_usual(places.num_own, cells);
    keep_large(cells, size[0] * size[1], size[1]);
    add_rim(counts.near, size[0], size[1], cells);
  });
}
