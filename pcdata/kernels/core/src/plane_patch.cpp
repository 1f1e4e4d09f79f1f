// Points near a plane as seen along its normal: which lie in chosen cells of it, and which may be on their outline.
#include <cmath>
#include <limits>

#include "pc/memory.hpp"
#include "pc/planes/runs.hpp"
#include "pc/threads.hpp"

namespace pc::planes {
namespace {

constexpr int64_t kPieceRuns = 128;  // runs that are looked at on their own; what they give is put together in order

struct Axis {
  float x, y, z;

  explicit Axis(const double* from)
      : x(static_cast<float>(from[0])), y(static_cast<float>(from[1])), z(static_cast<float>(from[2])) {}
  FloatRegister along(const FloatRegister& px, const FloatRegister& py, const FloatRegister& pz) const {
    return (px * x + py * y) + pz * z;
  }
};

// Cells of one direction: where they begin, how many there are, and how many to a metre.
struct Cells {
  float low, scale;
  int64_t count;

  // Two cells lie before `low`; the first and the last hold all that is farther away.
  Int32Register of(const FloatRegister& along) const {
    const FloatRegister none = {}, from = (along - low) * scale;
    const FloatRegister held = minimum(maximum(from, none - 2), none + static_cast<float>(count));
    const Int32Register place = floored(held) + 2, last = Int32Register{} + static_cast<int32_t>(count - 1);
    return select(less(last, place), last, place);
  }
};

// Polygons of points of an outline, and which points are well inside of them. Source: Akl & Toussaint, A fast convex
// hull algorithm, Information Processing Letters 7(5), 1978.
class Outline {
 public:
  Outline(const float* points, const uint8_t* chosen, int64_t count, const double* axes, ScratchFrame& scratch)
      : u_(axes), v_(axes + 3) {
    constexpr int64_t kLooked = 8192;  // points: some of the outline are as good as all
    const int64_t step = std::max<int64_t>(1, count / kLooked), most = (count + step - 1) / step + kLanes;
    float *u = scratch.take<float>(most), *v = scratch.take<float>(most);
    int32_t* row = scratch.take<int32_t>(most);
    int64_t some = 0;
    for (int64_t i = 0; i < count; i += step) {
      if (!chosen[i]) continue;
      const float* p = points + 3 * i;
      u[some] = (p[0] * u_.x + p[1] * u_.y) + p[2] * u_.z;
      v[some] = (p[0] * v_.x + p[1] * v_.y) + p[2] * v_.z;
      row[some++] = static_cast<int32_t>(i / step);
    }
    if (some == 0) return;
    for (int64_t i = some; i % kLanes != 0; ++i) u[i] = u[0], v[i] = v[0], row[i] = row[0];
    double x[kCorners], y[kCorners];
    for (int k = 0; k < kCorners; ++k) {
      constexpr double kTurn = 6.283185307179586 / kCorners;
      const float* p = points + 3 * step * farthest(u, v, row, some, std::cos(k * kTurn), std::sin(k * kTurn));
      x[k] = (p[0] * axes[0] + p[1] * axes[1]) + p[2] * axes[2];
      y[k] = (p[0] * axes[3] + p[1] * axes[4]) + p[2] * axes[5];
    }
    const double wide = x[0] - x[kCorners / 2], high = y[kCorners / 4] - y[3 * kCorners / 4];
    const double size = wide * wide + high * high;
    // Above what rounding of floats does, beside what near_outline leaves to doubles.
    if (!(size > 0 && size < kHuge)) return;
    coarse_ = Polygon(x, y, kCoarse, size);
    fine_ = Polygon(x, y, 1, size);
  }

  // Lanes of points that are well inside; all others, and perhaps some of those, may be corners.
  uint32_t inside(const FloatRegister& x, const FloatRegister& y, const FloatRegister& z, uint32_t asked) const {
    const FloatRegister u = u_.along(x, y, z), v = v_.along(x, y, z);
    const FloatRegister size = (magnitude(x) + magnitude(y)) + magnitude(z);
    const uint32_t found = coarse_.holds(u, v, size).bits();
    return (asked & ~found) == 0 ? found : found | fine_.holds(u, v, size).bits();
  }

 private:
  static constexpr int kCorners = 32, kCoarse = 4;  // of the coarse polygon every fourth: it holds nearly all points

  struct Edge {
    float x, y, ex, ey, doubt, least;
  };

  struct Polygon {
    Edge edges[kCorners] = {};
    int num_edges = 0;

    Polygon() = default;
    Polygon(const double* x, const double* y, int step, double size) {
      for (int k = 0; k < kCorners; k += step) {
        const int next = (k + step) % kCorners;
        const double ex = x[next] - x[k], ey = y[next] - y[k];
        if (ex == 0 && ey == 0) continue;
        const double least = 1e-6 * size, reach = std::fabs(x[k]) + std::fabs(y[k]);
        const double doubt = 4 * kRounding * (std::fabs(ex) + std::fabs(ey));
        edges[num_edges++] = {static_cast<float>(x[k]),  static_cast<float>(y[k]),
                              static_cast<float>(ex),    static_cast<float>(ey),
                              static_cast<float>(doubt), static_cast<float>(least + doubt * reach)};
      }
    }

    RegisterMask holds(const FloatRegister& u, const FloatRegister& v, const FloatRegister& size) const {
      RegisterMask inside = less(size, FloatRegister{} + (num_edges < 3 ? -1.0F : kHuge));
      for (int e = 0; e < num_edges; ++e) {
        const Edge& edge = edges[e];
        const FloatRegister cross = edge.ex * (v - edge.y) - edge.ey * (u - edge.x);
        inside = inside & less(edge.doubt * size + edge.least, cross);
      }
      return inside;
    }
  };

  // The row of one of the points farthest along a direction.
  static int64_t farthest(const float* u, const float* v, const int32_t* row, int64_t count, double du, double dv) {
    const auto right = static_cast<float>(du), up = static_cast<float>(dv);
    FloatRegister most = FloatRegister{} - std::numeric_limits<float>::infinity();
    auto best = load<Int32Register>(row);
    for (int64_t i = 0; i < count; i += kLanes) {
      const FloatRegister along = right * load<FloatRegister>(u + i) + up * load<FloatRegister>(v + i);
      const RegisterMask farther = less(most, along);
      best = select(farther, load<Int32Register>(row + i), best);
      most = select(farther, along, most);
    }
    int lane = 0;
    for (int i = 1; i < kLanes; ++i)
      if (most[i] > most[lane]) lane = i;
    return best[lane];
  }

  Axis u_, v_;
  Polygon coarse_, fine_;
};

// One bit for each of up to 64 bytes of 0 and 1.
uint64_t bits_of(const uint8_t* bytes, int64_t count) {
  uint64_t bits = 0;
  for (int64_t i = 0; i < count; i += 8) {
    uint64_t eight = 0;
    std::memcpy(&eight, bytes + i, static_cast<size_t>(std::min<int64_t>(8, count - i)));
    bits |= (eight * 0x0102040810204080U >> 56) << i;
  }
  return bits;
}

// Add the squared distances of chosen points of a run from a plane, in eight lanes whatever the instruction set.
void add_squares(const RunPoints& points, uint64_t chosen, const double* plane, Double8& sum) {
  alignas(64) float axes[3][kRun];
  points.each([&](const FloatRegister& x, const FloatRegister& y, const FloatRegister& z, int i) {
    store(axes[0] + i, x);
    store(axes[1] + i, y);
    store(axes[2] + i, z);
  });
  for (int i = 0; i < kRun; i += 8) {
    const auto mine = static_cast<int64_t>(chosen >> i & 0xFF);
    if (mine == 0) continue;
    constexpr Long8 places = {1, 2, 4, 8, 16, 32, 64, 128};
    const auto wide = [&](int axis) { return __builtin_convertvector(load<Float8>(axes[axis] + i), Double8); };
    const Double8 off = ((wide(0) * plane[0] + wide(1) * plane[1]) + wide(2) * plane[2]) + plane[3];
    sum += reinterpret_cast<Double8>(reinterpret_cast<Long8>(off * off) & ((places & mine) != 0));
  }
}

}  // namespace
}  // namespace pc::planes

PC_EXPORT int32_t pc_outline_points(const pc_context* context, const float* points, const uint8_t* chosen,
                                    int64_t count, const double* plane, const double* axes, int64_t* rows,
                                    int64_t* num_rows, double* squares) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    ScratchFrame scratch;
    const Outline outline(points, chosen, count, axes, scratch);
    const int64_t num_runs = (count + kRun - 1) / kRun, num_pieces = (num_runs + kPieceRuns - 1) / kPieceRuns;
    std::vector<std::vector<int64_t>> found(static_cast<size_t>(num_pieces));
    std::vector<double> sums(static_cast<size_t>(num_pieces));
    parallel_for(*context, num_pieces, 1, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t piece = first; piece < last; ++piece) {
        Double8 sum{};
        for (int64_t run = piece * kPieceRuns; run < std::min(num_runs, (piece + 1) * kPieceRuns); ++run) {
          const uint64_t mine = bits_of(chosen + kRun * run, std::min<int64_t>(kRun, count - kRun * run));
          if (mine == 0) continue;
          const RunPoints own(points, count, run);
          uint64_t inside = 0;
          own.each([&](const FloatRegister& x, const FloatRegister& y, const FloatRegister& z, int i) {
            const auto asked = static_cast<uint32_t>(mine >> i) & all_lanes().bits();
            inside |= static_cast<uint64_t>(outline.inside(x, y, z, asked)) << i;
          });
          for (uint64_t bits = mine & ~inside; bits != 0; bits &= bits - 1)
            found[static_cast<size_t>(piece)].push_back(kRun * run + __builtin_ctzll(bits));
          add_squares(own, mine, plane, sum);
        }
        sums[static_cast<size_t>(piece)] = reduce<double>(sum, [](const auto& a, const auto& b) { return a + b; });
      }
    });
    *squares = 0;
    *num_rows = 0;
    for (int64_t piece = 0; piece < num_pieces; ++piece) {
      *squares += sums[static_cast<size_t>(piece)];
      for (const int64_t row : found[static_cast<size_t>(piece)]) rows[(*num_rows)++] = row;
    }
  });
}

PC_EXPORT int32_t pc_points_in_cells(const pc_context* context, const float* points, const uint8_t* chosen,
                                     int64_t count, const double* axes, const double* low, double scale,
                                     const uint8_t* cells, int64_t height, int64_t width, uint8_t* inside) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const Axis down(axes), right(axes + 3);
    const auto per_unit = static_cast<float>(scale);
    const Cells rows{static_cast<float>(low[0]), per_unit, height},
        columns{static_cast<float>(low[1]), per_unit, width};
    parallel_for(*context, (count + kRun - 1) / kRun, kPieceRuns, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t run = begin; run < end; ++run) {
        const RunPoints own(points, count, run);
        const uint8_t* mine = chosen + kRun * run;
        uint8_t* to = inside + kRun * run;
        if (std::memchr(mine, 1, static_cast<size_t>(own.size())) == nullptr) {
          std::fill_n(to, own.size(), uint8_t{0});
          continue;
        }
        int32_t place[kRun];
        own.each([&](const FloatRegister& x, const FloatRegister& y, const FloatRegister& z, int i) {
          const Int32Register row = rows.of(down.along(x, y, z)), column = columns.of(right.along(x, y, z));
          store(place + i, row * static_cast<int32_t>(width) + column);
        });
        for (int i = 0; i < own.size(); ++i) to[i] = mine[i] & cells[place[i]];
      }
    });
  });
}
