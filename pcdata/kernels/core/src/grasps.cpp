// Points inside grippers: palm, fingers, and the room between them.
#include <cmath>

#include "pc/math/bounds.hpp"
#include "pc/memory.hpp"
#include "pc/threads.hpp"

namespace pc::grasps {
namespace {

constexpr int kBoxes = 4;       // palm, two fingers, the room between them
constexpr double kPad = 1e-12;  // of the largest coordinate: thousands of times what a rough test in doubles errs by

// The points sorted into cubes, about one for each point, so that a gripper only meets what lies around it.
class PointGrid {
 public:
  PointGrid(ScratchFrame& scratch, const float* points, int64_t count)
      : x_(scratch.take<double>(count)), y_(scratch.take<double>(count)), z_(scratch.take<double>(count)) {
    double low[3], high[3];
    for (int axis = 0; axis < 3; ++axis) low[axis] = high[axis] = points[axis];
    for (int64_t i = 0; i < count; ++i)
      for (int axis = 0; axis < 3; ++axis) {
        const double value = points[3 * i + axis];
        low[axis] = std::min(low[axis], value);
        high[axis] = std::max(high[axis], value);
      }
    double widest = 0;
    for (int axis = 0; axis < 3; ++axis) {
      low_[axis] = low[axis];
      extent_[axis] = high[axis] - low[axis];
      widest = std::max(widest, extent_[axis]);
      most_ = std::max({most_, std::fabs(low[axis]), std::fabs(high[axis])});
    }
    side_ = widest > 0 ? widest / 1024 : 1;
    const double room = static_cast<double>(std::max<int64_t>(count, 64));
    while (cells_along(0) * cells_along(1) * cells_along(2) > room) side_ *= 1.2;
    for (int axis = 0; axis < 3; ++axis) dims_[axis] = static_cast<int64_t>(cells_along(axis));
    const int64_t cells = dims_[0] * dims_[1] * dims_[2];
    start_ = scratch.take<int64_t>(cells + 2);
    std::fill_n(start_, cells + 2, int64_t{0});
    int64_t* cell = scratch.take<int64_t>(count);
    for (int64_t i = 0; i < count; ++i) {
      const float* p = points + 3 * i;
      cell[i] = (along(p[0], 0) * dims_[1] + along(p[1], 1)) * dims_[2] + along(p[2], 2);
      ++start_[cell[i] + 2];
    }
    for (int64_t c = 2; c < cells + 2; ++c) start_[c] += start_[c - 1];
    for (int64_t i = 0; i < count; ++i) {
      const int64_t to = start_[cell[i] + 1]++;
      x_[to] = points[3 * i], y_[to] = points[3 * i + 1], z_[to] = points[3 * i + 2];
    }
  }

  // The cell that a coordinate lies in, or the nearest one: never falls where the coordinate rises.
  int64_t along(double value, int axis) const {
    const double place = std::floor((value - low_[axis]) / side_);
    return place < 0 ? 0 : place < static_cast<double>(dims_[axis]) ? static_cast<int64_t>(place) : dims_[axis] - 1;
  }
  bool reaches(double from, double to, int axis) const {
    return to >= low_[axis] && from <= low_[axis] + extent_[axis];
  }
  double middle(int64_t cell, int axis) const { return low_[axis] + (static_cast<double>(cell) + 0.5) * side_; }
  double side() const { return side_; }
  double low(int axis) const { return low_[axis]; }
  double high(int axis) const { return low_[axis] + extent_[axis]; }
  double largest() const { return most_; }

  // The points of cells from..to of a row along z.
  Range row(int64_t x, int64_t y, int64_t from, int64_t to) const {
    const int64_t first = (x * dims_[1] + y) * dims_[2];
    return {start_[first + from], start_[first + to + 1]};
  }
  const double* x() const { return x_; }
  const double* y() const { return y_; }
  const double* z() const { return z_; }

 private:
  double cells_along(int axis) const { return std::floor(extent_[axis] / side_) + 1; }

  double *x_, *y_, *z_;  // (n,) cell after cell
  double low_[3], extent_[3], most_ = 0, side_;
  int64_t dims_[3];
  int64_t* start_;  // (cells + 1,)
};

// One gripper: axes in rows, corners of its boxes along them.
struct Gripper {
  double axes[3][3], origin[3], low[kBoxes][3], high[kBoxes][3];

  // Count the points of a range: the sums of the reference, in its order.
  void count(const PointGrid& grid, Range points, int64_t& hits, int64_t& held) const {
    const double *x = grid.x(), *y = grid.y(), *z = grid.z();
    const Gripper own = *this;  // in registers: nothing else may change it
    int64_t in_gripper = 0, between = 0;
    for (int64_t i = points.begin; i < points.end; ++i) {
      const double dx = x[i] - own.origin[0], dy = y[i] - own.origin[1], dz = z[i] - own.origin[2];
      double at[3];
      for (int k = 0; k < 3; ++k) at[k] = (dx * own.axes[k][0] + dy * own.axes[k][1]) + dz * own.axes[k][2];
      int64_t inside[kBoxes];
      for (int b = 0; b < kBoxes; ++b) {
        inside[b] = (b ? at[0] > own.low[b][0] : at[0] >= own.low[b][0]) & (at[0] <= own.high[b][0]) &
                    (at[1] >= own.low[b][1]) & (at[1] <= own.high[b][1]) & (at[2] >= own.low[b][2]) &
                    (at[2] <= own.high[b][2]);
      }
      in_gripper += inside[0] + inside[1] + inside[2];
      between += inside[3];
    }
    hits += in_gripper;
    held += between;
  }
};

// Meet the rows of cells that a gripper's bounding box crosses.
class Search {
 public:
  Search(const PointGrid& grid, const Gripper& gripper) : grid_(grid), gripper_(gripper) {
    double scale = grid.largest();
    for (int k = 0; k < 3; ++k) {
      double low = gripper.low[0][k], high = gripper.high[0][k];
      for (int b = 1; b < kBoxes; ++b) {
        low = std::min(low, gripper.low[b][k]);
        high = std::max(high, gripper.high[b][k]);
      }
      middle_[k] = (low + high) / 2;
      half_[k] = (high - low) / 2;
      scale = std::max({scale, std::fabs(gripper.origin[k]), std::fabs(low), std::fabs(high)});
    }
    pad_ = kPad * scale;
    for (int k = 0; k < 3; ++k) half_[k] += pad_;
  }

  void run(int64_t& hits, int64_t& held) const {
    double from[3], to[3];
    bounds(from, to);
    for (int axis = 0; axis < 3; ++axis)
      if (!grid_.reaches(from[axis], to[axis], axis)) return;
    const int64_t last_x = grid_.along(to[0], 0), first_y = grid_.along(from[1], 1), last_y = grid_.along(to[1], 1);
    for (int64_t x = grid_.along(from[0], 0); x <= last_x; ++x)
      for (int64_t y = first_y; y <= last_y; ++y) {
        double low = std::max(from[2], grid_.low(2)), high = std::min(to[2], grid_.high(2));
        for (int k = 0; k < 3; ++k) narrow(k, grid_.middle(x, 0), grid_.middle(y, 1), low, high);
        if (low > high) continue;
        const Range points = grid_.row(x, y, grid_.along(low, 2), grid_.along(high, 2));
        if (points.begin < points.end) gripper_.count(grid_, points, hits, held);
      }
  }

 private:
  // Corners, in the coordinates of the points, of a box around the bounding box: by the inverse of the axes, which are
  // orthonormal only as far as the pose of the grasp is.
  void bounds(double* from, double* to) const {
    const auto& a = gripper_.axes;
    double inverse[3][3];
    for (int k = 0; k < 3; ++k) {
      const double *p = a[(k + 1) % 3], *q = a[(k + 2) % 3];
      inverse[0][k] = p[1] * q[2] - p[2] * q[1];
      inverse[1][k] = p[2] * q[0] - p[0] * q[2];
      inverse[2][k] = p[0] * q[1] - p[1] * q[0];
    }
    const double determinant = a[0][0] * inverse[0][0] + a[0][1] * inverse[1][0] + a[0][2] * inverse[2][0];
    for (int axis = 0; axis < 3; ++axis) {
      double middle = gripper_.origin[axis], reach = pad_;
      for (int k = 0; k < 3; ++k) {
        middle += inverse[axis][k] / determinant * middle_[k];
        reach += std::fabs(inverse[axis][k] / determinant) * half_[k];
      }
      from[axis] = middle - reach;
      to[axis] = middle + reach;
    }
  }

  // Keep of a row of cells around (x, y) what can be within the bounding box along one of its axes.
  void narrow(int k, double x, double y, double& low, double& high) const {
    constexpr double kLevel = 1e-6;
    const double* axis = gripper_.axes[k];
    const double across = axis[0] * (x - gripper_.origin[0]) + axis[1] * (y - gripper_.origin[1]) - middle_[k];
    const double reach = half_[k] + (std::fabs(axis[0]) + std::fabs(axis[1])) * grid_.side() / 2;
    if (std::fabs(axis[2]) < kLevel) {
      const double far = std::max(std::fabs(grid_.low(2)), std::fabs(grid_.high(2))) + std::fabs(gripper_.origin[2]);
      if (std::fabs(across) > reach + kLevel * far) high = low - 1;
      return;
    }
    double one = gripper_.origin[2] - (across + reach) / axis[2],
           other = gripper_.origin[2] - (across - reach) / axis[2];
    if (one > other) std::swap(one, other);
    low = std::max(low, one);
    high = std::min(high, other);
  }

  const PointGrid& grid_;
  const Gripper& gripper_;
  double middle_[3], half_[3], pad_;
};

}  // namespace
}  // namespace pc::grasps

PC_EXPORT int32_t pc_points_in_grippers(const pc_context* context, const float* points, int64_t count,
                                        const double* axes, const double* origin, const double* lower,
                                        const double* upper, int64_t num_grasps, int64_t* hits, int64_t* held) {
  using namespace pc;
  using namespace pc::grasps;
  return guarded([&] {
    std::fill_n(hits, num_grasps, int64_t{0});
    std::fill_n(held, num_grasps, int64_t{0});
    if (count == 0) return;
    ScratchFrame scratch;
    const PointGrid grid(scratch, points, count);
    parallel_for(*context, num_grasps, 16, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t g = begin; g < end; ++g) {
        Gripper gripper;
        for (int k = 0; k < 3; ++k) {
          gripper.origin[k] = origin[3 * g + k];
          for (int j = 0; j < 3; ++j) gripper.axes[k][j] = axes[9 * g + 3 * k + j];
          for (int b = 0; b < kBoxes; ++b) {
            gripper.low[b][k] = lower[3 * (b * num_grasps + g) + k];
            gripper.high[b][k] = upper[3 * (b * num_grasps + g) + k];
          }
        }
        Search(grid, gripper).run(hits[g], held[g]);
      }
    });
  });
}
