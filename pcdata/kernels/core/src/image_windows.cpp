// What pixels of a depth image are to those around them: flying pixels, the medians of windows, and connected parts.
#include <cmath>
#include <limits>

#include "pc/cells/union_find.hpp"
#include "pc/images/padded_rows.hpp"
#include "pc/memory.hpp"

namespace pc::windows {
namespace {

constexpr int64_t kPiece = 1 << 13;  // points that a thread takes at once

// -- flying pixels ------------------------------------------------------------------------------------------------

constexpr int kColumns = 256;  // of a row at once; as many are looked at beyond the last one

// Say which of as many neighbors in a row as a register holds fly; rows[r][i] is left of pixel i, row r - 1.
RegisterMask flying_pixels(const float* const* rows, const FloatRegister& tolerance, const Int32Register& least) {
  const FloatRegister own = load<FloatRegister>(rows[1] + 1), zero{};
  Int32Register on_surface{}, around{};  // how many of the eight lie there, and have a reading
  const Int32Register one = Int32Register{} + 1;
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) {
      if (r == 1 && c == 1) continue;
      const FloatRegister other = load<FloatRegister>(rows[r] + c), nearer = minimum(own, other), apart = own - other;
      const RegisterMask both = less(zero, nearer), same = both & less_equal(magnitude(apart), tolerance * nearer);
      around = select(both, around + one, around);
      on_surface = select(same, on_surface + one, on_surface);
    }
  return unequal(on_surface, around) & less(on_surface, least);
}

// -- medians of 3 x 3 pixels --------------------------------------------------------------------------------------

// 19 exchanges leave the median of nine in the middle. Source: Smith, Implementing median filters in XC4000E FPGAs,
// Xcell 23, 1996.
constexpr int kExchanges[19][2] = {{1, 2}, {4, 5}, {7, 8}, {0, 1}, {3, 4}, {6, 7}, {1, 2}, {4, 5}, {7, 8}, {0, 3},
                                   {5, 8}, {4, 7}, {3, 6}, {1, 4}, {2, 5}, {4, 7}, {4, 2}, {6, 4}, {4, 2}};
constexpr int kRun = 64;     // neighbors in a row that are sorted side by side,
constexpr int kAtOnce = 16;  // so many at a time

// The lower median of those of nine values that are numbers.
float median_of_some(const float* const* rows, int64_t at) {
  float kept[9];
  int count = 0;
  for (int r = 0; r < 3; ++r)
    for (int64_t c = at; c < at + 3; ++c)
      if (rows[r][c] == rows[r][c]) kept[count++] = rows[r][c];
  if (count == 0) return std::numeric_limits<float>::quiet_NaN();
  std::nth_element(kept, kept + (count - 1) / 2, kept + count);
  return kept[(count - 1) / 2];
}

// Write the medians around `count` pixels that are neighbors in a row; rows[r][i] is left of pixel i, row r - 1.
void medians_of_run(const float* const* rows, int64_t count, float* medians) {
  for (int64_t first = 0; first < count; first += kRun) {
    const auto some = static_cast<int>(std::min<int64_t>(kRun, count - first));
    const int whole = (some + kAtOnce - 1) / kAtOnce * kAtOnce;
    float values[9][kRun] = {};
    float sum[kRun] = {};  // NaN where a pixel has no point
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c)
        for (int i = 0; i < some; ++i) {
          const float value = rows[r][first + i + c];
          values[3 * r + c][i] = value;
          sum[i] += value * 0.0F;
        }
    for (const auto& pair : kExchanges) {
      float *low = values[pair[0]], *high = values[pair[1]];
      for (int i = 0; i < whole; ++i) {
        const float a = low[i], b = high[i];
        low[i] = a < b ? a : b;
        high[i] = a < b ? b : a;
      }
    }
    for (int i = 0; i < some; ++i) medians[first + i] = sum[i] == 0 ? values[4][i] : median_of_some(rows, first + i);
  }
}

// -- connected parts ----------------------------------------------------------------------------------------------

struct Linking {
  const float* points;    // of the cloud
  const int64_t* pixel;   // (n,) rising
  const int32_t* row_of;  // (H * W,) of each pixel, -1 = none
  int64_t height, width, reach;
  float limit;  // of squared distances

  bool near(int64_t a, int64_t b) const {
    const float *p = points + 3 * a, *q = points + 3 * b;
    const float dx = p[0] - q[0], dy = p[1] - q[1], dz = p[2] - q[2];
    return (dx * dx + dy * dy) + dz * dz < limit;
  }

  void join(Range rows, cells::UnionFind& parts) const {
    for (int64_t i = rows.begin; i < rows.end; ++i) {
      const int64_t v = pixel[i] / width, u = pixel[i] % width;
      for (int64_t down = 0; down <= reach && v + down < height; ++down) {
        const int64_t from = down == 0 ? u + 1 : std::max<int64_t>(u - reach, 0), to = std::min(u + reach, width - 1);
        for (int64_t column = from; column <= to; ++column) {
          const int64_t other = row_of[(v + down) * width + column];
          if (other >= 0 && near(i, other)) parts.join(static_cast<uint32_t>(i), static_cast<uint32_t>(other));
        }
      }
    }
  }
};

}  // namespace
}  // namespace pc::windows

PC_EXPORT int32_t pc_flying_pixels(const pc_context* context, const float* depth, int64_t num_views, int64_t height,
                                   int64_t width, double tolerance, int64_t least, uint8_t* flying) {
  using namespace pc;
  using namespace pc::windows;
  return guarded([&] {
    const FloatRegister part = FloatRegister{} + static_cast<float>(tolerance);
    const Int32Register wanted = Int32Register{} + static_cast<int32_t>(least);
    images::for_rows(*context, depth, {num_views, height, width}, 1, [&](int64_t row, const float* const* rows) {
      for (int64_t first = 0; first < width; first += kColumns) {
        const int64_t last = std::min(first + kColumns, width);
        alignas(64) int32_t found[kColumns];
        for (int64_t u = first; u < last; u += kLanes) {
          const float* const some[3] = {rows[0] + u, rows[1] + u, rows[2] + u};
          const RegisterMask fly = flying_pixels(some, part, wanted);
          store(found + (u - first), select(fly, Int32Register{} + 1, Int32Register{}));
        }
        uint8_t* to = flying + row * width + first;
        const auto count = static_cast<int>(last - first);  // not read again after each byte, which may lie anywhere
        for (int i = 0; i < count; ++i) to[i] = static_cast<uint8_t>(found[i]);
      }
    });
  });
}

PC_EXPORT int32_t pc_without_flying_pixels(const pc_context* context, const float* depth, int64_t num_views,
                                           int64_t height, int64_t width, int64_t is_masked, double near, double far,
                                           const uint8_t* mask, double tolerance, int64_t least,
                                           const uint8_t* confidence, float* kept, uint8_t* kept_confidence) {
  using namespace pc;
  using namespace pc::windows;
  return guarded([&] {
    const FloatRegister part = FloatRegister{} + static_cast<float>(tolerance);
    const Int32Register wanted = Int32Register{} + static_cast<int32_t>(least);
    const images::DepthRange range{static_cast<float>(near), static_cast<float>(far), mask};
    const auto without = [&](int64_t row, const float* const* rows) {
      float* to = kept + row * width;
      for (int64_t u = 0; u < width; u += kLanes) {
        const float* const some[3] = {rows[0] + u, rows[1] + u, rows[2] + u};
        const FloatRegister own = load<FloatRegister>(rows[1] + u + 1);
        const FloatRegister left = select(flying_pixels(some, part, wanted), FloatRegister{}, own);
        std::memcpy(to + u, &left, static_cast<size_t>(std::min<int64_t>(kLanes, width - u)) * sizeof(float));
      }
      if (confidence == nullptr) return;
      const float* own = rows[1] + 1;
      const uint8_t* was = confidence + row * width;
      uint8_t* now = kept_confidence + row * width;
      for (int64_t u = 0; u < width; ++u) now[u] = own[u] > 0 && to[u] == 0 ? uint8_t{0} : was[u];
    };
    images::for_rows(*context, depth, {num_views, height, width}, 1, without, is_masked != 0 ? &range : nullptr);
  });
}

PC_EXPORT int32_t pc_window_medians(const pc_context* context, const float* values, const int64_t* pixel,
                                    const int64_t* ptr, int64_t num_clouds, int64_t height, int64_t width,
                                    float* medians) {
  using namespace pc;
  using namespace pc::windows;
  return guarded([&] {
    ScratchFrame scratch;
    const int64_t stride = width + 2;
    float* image = scratch.take<float>((height + 2) * stride);
    const float none = std::numeric_limits<float>::quiet_NaN();
    const auto place = [&](int64_t p) { return (p / width + 1) * stride + p % width + 1; };
    parallel_for(*context, (height + 2) * stride, 1 << 16,
                 [&](int64_t begin, int64_t end, int64_t) { std::fill(image + begin, image + end, none); });
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud) {
      const int64_t first = ptr[cloud], count = ptr[cloud + 1] - first;
      parallel_for(*context, count, kPiece, [&](int64_t begin, int64_t end, int64_t) {
        for (int64_t i = first + begin; i < first + end; ++i) image[place(pixel[i])] = values[i];
      });
      parallel_for(*context, count, kPiece, [&](int64_t begin, int64_t end, int64_t) {
        for (int64_t i = first + begin; i < first + end;) {
          const int64_t left = width - pixel[i] % width;  // pixels of this row
          int64_t run = 1;
          while (run < left && i + run < first + end && pixel[i + run] == pixel[i] + run) ++run;
          const float* middle = image + place(pixel[i]) - 1;
          const float* rows[3] = {middle - stride, middle, middle + stride};
          medians_of_run(rows, run, medians + i);
          i += run;
        }
      });
      if (cloud + 1 == num_clouds) break;
      for (int64_t i = first; i < first + count; ++i) image[place(pixel[i])] = none;
    }
  });
}

PC_EXPORT int32_t pc_linked_pixels(const pc_context* context, const float* points, const int64_t* pixel,
                                   const int64_t* ptr, int64_t num_clouds, int64_t height, int64_t width, double limit,
                                   int64_t reach, int64_t* label) {
  using namespace pc;
  using namespace pc::windows;
  return guarded([&] {
    ScratchFrame scratch;
    int64_t most = 0;
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud) most = std::max(most, ptr[cloud + 1] - ptr[cloud]);
    int32_t* row_of = scratch.take<int32_t>(height * width);
    auto* parents = scratch.take<std::atomic<uint32_t>>(most);
    parallel_for(*context, height * width, 1 << 16,
                 [&](int64_t begin, int64_t end, int64_t) { std::fill(row_of + begin, row_of + end, -1); });
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud) {
      const int64_t first = ptr[cloud], count = ptr[cloud + 1] - first;
      const int64_t* own = pixel + first;
      for (int64_t i = 0; i < count; ++i) row_of[own[i]] = static_cast<int32_t>(i);
      const Linking linking{points + 3 * first, own, row_of, height, width, reach, static_cast<float>(limit)};
      cells::UnionFind parts(parents, count);
      parallel_for(*context, count, kPiece,
                   [&](int64_t begin, int64_t end, int64_t) { linking.join({begin, end}, parts); });
      int64_t next = 0;
      for (int64_t i = 0; i < count;
           ++i) {  // a part is named by its lowest row, so its number is there before others ask
        const int64_t lowest = parts.find(static_cast<uint32_t>(i));
        label[first + i] = lowest == i ? next++ : label[first + lowest];
      }
      if (cloud + 1 == num_clouds) break;
      for (int64_t i = 0; i < count; ++i) row_of[own[i]] = -1;
    }
  });
}
