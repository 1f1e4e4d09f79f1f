// The convex hull of points in a plane.
#pragma once

#include <algorithm>
#include <limits>
#include <numeric>
#include <vector>

#include "pc/threads.hpp"

namespace pc::outline {

constexpr double kOff = 1e-12;  // of an edge's squared length: twice the area of the flattest triangle that counts

struct Edge {
  int64_t from, to;
  std::vector<int64_t> outside;  // rows to its right, rising
  int64_t farthest;              // the first of them that is farthest from it
};

class Hull {
 public:
  explicit Hull(const double* points) : points_(points) {}

  // Which of some rows lie outside an edge; `row` gives them by their number.
  template <class Rows>
  Edge edge(int64_t from, int64_t to, int64_t count, const Rows& row) const {
    Edge found{from, to, {}, -1};
    const double fx = points_[2 * from], fy = points_[2 * from + 1];
    const double ex = points_[2 * to] - fx, ey = points_[2 * to + 1] - fy;
    const double least = kOff * (ex * ex + ey * ey);
    double most = least;
    for (int64_t i = 0; i < count; ++i) {
      const int64_t at = row(i);
      const double beyond = (points_[2 * at] - fx) * ey - (points_[2 * at + 1] - fy) * ex;
      if (!(beyond > least)) continue;
      found.outside.push_back(at);
      if (beyond > most) most = beyond, found.farthest = at;
    }
    return found;
  }

  // Walk round from the leftmost point; edges are divided at the point farthest outside, as the reference does.
  int64_t run(const std::vector<int64_t>& rows, int64_t first, int64_t last, Poll& poll, int64_t* corners) const {
    const auto all = [&](int64_t i) { return rows[static_cast<size_t>(i)]; };
    const auto count = static_cast<int64_t>(rows.size());
    std::vector<Edge> open;
    open.push_back(edge(last, first, count, all));
    open.push_back(edge(first, last, count, all));
    int64_t found = 0;
    while (!open.empty()) {
      poll.check();
      const Edge now = std::move(open.back());
      open.pop_back();
      if (now.outside.empty()) {
        corners[found++] = now.from;
        continue;
      }
      const auto some = [&](int64_t i) { return now.outside[static_cast<size_t>(i)]; };
      const auto size = static_cast<int64_t>(now.outside.size());
      open.push_back(edge(now.farthest, now.to, size, some));
      open.push_back(edge(now.from, now.farthest, size, some));
    }
    return found;
  }

 private:
  const double* points_;
};

inline std::vector<int64_t> every_row(int64_t count) {
  std::vector<int64_t> rows(static_cast<size_t>(count));
  std::iota(rows.begin(), rows.end(), int64_t{0});
  return rows;
}

// Rows that may be corners, rising: all but those well inside of a polygon that some of the points make. Such a point
// is not a corner of the hull, and farthest from no chord of it. Source: Akl & Toussaint, A fast convex hull algorithm,
// Information Processing Letters 7(5), 1978.
inline std::vector<int64_t> near_outline(const double* points, int64_t count) {
  constexpr int64_t kFew = 512, kStep = 8;  // every eighth point tells as much of the outline
  constexpr double kInside = 1e-9;          // of the outline's squared size: far above what rounding does
  if (count < kFew) return every_row(count);
  // The farthest points in eight directions, counterclockwise, as a polygon.
  constexpr double kDirections[8][2] = {{1, 0}, {1, 1}, {0, 1}, {-1, 1}, {-1, 0}, {-1, -1}, {0, -1}, {1, -1}};
  int64_t corner[8] = {};
  double most[8];
  std::fill_n(most, 8, -std::numeric_limits<double>::infinity());
  for (int64_t i = 0; i < count; i += kStep)
    for (int d = 0; d < 8; ++d) {
      const double along = kDirections[d][0] * points[2 * i] + kDirections[d][1] * points[2 * i + 1];
      if (along > most[d]) most[d] = along, corner[d] = i;
    }
  const double wide = most[0] + most[4], high = most[2] + most[6];
  const double least = kInside * (wide * wide + high * high);
  if (least == 0) return every_row(count);
  double x[8], y[8], ex[8], ey[8];
  for (int d = 0; d < 8; ++d) {
    const double *from = points + 2 * corner[d], *to = points + 2 * corner[(d + 1) % 8];
    x[d] = from[0], y[d] = from[1], ex[d] = to[0] - from[0], ey[d] = to[1] - from[1];
  }
  std::vector<int64_t> rows;
  for (int64_t begin = 0; begin < count; begin += kFew) {
    const auto some = static_cast<int>(std::min(kFew, count - begin));
    double inside[kFew];  // the least of the distances from all edges, times their lengths
    std::fill_n(inside, kFew, std::numeric_limits<double>::infinity());
    for (int d = 0; d < 8; ++d) {
      if (ex[d] == 0 && ey[d] == 0) continue;  // one point is the farthest in both directions
      for (int i = 0; i < some; ++i) {
        const double *p = points + 2 * (begin + i), cross = ex[d] * (p[1] - y[d]) - ey[d] * (p[0] - x[d]);
        inside[i] = cross < inside[i] ? cross : inside[i];
      }
    }
    for (int i = 0; i < some; ++i)
      if (!(inside[i] > least)) rows.push_back(begin + i);
  }
  return rows;
}

// Write the rows of the corners of points (count, 2) in a plane, counterclockwise, to room for all; return how many.
inline int64_t convex_hull(const pc_context& context, const double* points, int64_t count, int64_t* corners) {
  if (count == 0) return 0;
  const std::vector<int64_t> rows = near_outline(points, count);
  // The lowest of the leftmost points and the highest of the rightmost, each the first of equals.
  int64_t first = rows[0], last = rows[0];
  double left = points[2 * first], bottom = points[2 * first + 1], right = left, top = bottom;
  for (const int64_t i : rows) {
    const double x = points[2 * i], y = points[2 * i + 1];
    if (x < left || (x == left && y < bottom)) first = i, left = x, bottom = y;
    if (x > right || (x == right && y > top)) last = i, right = x, top = y;
  }
  if (left == right && bottom == top) {
    corners[0] = first;
    return 1;
  }
  Poll poll(context);
  return Hull(points).run(rows, first, last, poll, corners);
}

}  // namespace pc::outline
