// Which points may be on the outline of those of a plane.
#pragma once

#include "pc/memory.hpp"
#include "pc/planes/flat_cells.hpp"
#include "pc/planes/runs.hpp"

namespace pc::planes {

// Polygons of points of an outline, and which points are well inside of them. Source: Akl & Toussaint, A fast convex
// hull algorithm, Information Processing Letters 7(5), 1978.
class Outline {
 public:
  Outline(const pc_context& context, const float* points, const uint8_t* chosen, int64_t count, const PlaneAxes& axes,
          ScratchFrame& scratch)
      : u_(axes.down), v_(axes.right) {
    constexpr int64_t kLooked = 8192;  // points: some of the outline are as good as all
    const int64_t step = std::max<int64_t>(1, count / kLooked), most = (count + step - 1) / step + kLanes;
    float *u = scratch.take<float>(most), *v = scratch.take<float>(most);
    int32_t* row = scratch.take<int32_t>(most);
    int64_t some = 0;
    for (int64_t i = 0; i < count; i += step) {
      if (!chosen[i]) continue;
      const float* p = points + 3 * i;
      u[some] = u_.along(p);
      v[some] = v_.along(p);
      row[some++] = static_cast<int32_t>(i / step);
    }
    if (some == 0) return;
    for (int64_t i = some; i % kLanes != 0; ++i) u[i] = u[0], v[i] = v[0], row[i] = row[0];
    double x[kCorners], y[kCorners];
    parallel_for(context, kCorners, kCorners / 4, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t k = first; k < last; ++k) {
        const double turn = 6.283185307179586 / kCorners * static_cast<double>(k);
        const float* p = points + 3 * step * farthest(u, v, row, some, std::cos(turn), std::sin(turn));
        x[k] = axes.along_down(p);
        y[k] = axes.along_right(p);
      }
    });
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

}  // namespace pc::planes
