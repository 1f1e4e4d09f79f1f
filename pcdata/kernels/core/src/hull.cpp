// The convex hull of points in a plane.
#include <vector>

#include "pc/threads.hpp"

namespace pc::outline {
namespace {

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
  int64_t run(int64_t count, int64_t first, int64_t last, Poll& poll, int64_t* corners) const {
    const auto all = [](int64_t i) { return i; };
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

}  // namespace
}  // namespace pc::outline

PC_EXPORT int32_t pc_convex_hull(const pc_context* context, const double* points, int64_t count, int64_t* corners,
                                 int64_t* num_corners) {
  using namespace pc;
  using namespace pc::outline;
  return guarded([&] {
    *num_corners = 0;
    if (count == 0) return;
    // The lowest of the leftmost points and the highest of the rightmost, each the first of equals.
    int64_t first = 0, last = 0;
    double left = points[0], bottom = points[1], right = points[0], top = points[1];
    for (int64_t i = 1; i < count; ++i) {
      const double x = points[2 * i], y = points[2 * i + 1];
      if (x < left || (x == left && y < bottom)) first = i, left = x, bottom = y;
      if (x > right || (x == right && y > top)) last = i, right = x, top = y;
    }
    if (left == right && bottom == top) {
      corners[0] = first;
      *num_corners = 1;
      return;
    }
    Poll poll(*context);
    *num_corners = Hull(points).run(count, first, last, poll, corners);
  });
}
