// Whether two sets of points come near each other.
#pragma once

#include <vector>

#include "pc/cells/neighborhood.hpp"
#include "pc/math/bounds.hpp"

namespace pc::cells {

struct CellPoint {
  float coordinate[3];
};

inline math::Bounds box_around(const std::vector<CellPoint>& points, Range range) {
  auto bounds = math::Bounds::of_point(points[range.begin].coordinate);
  for (int64_t i = range.begin + 1; i < range.end; ++i) bounds.include(points[i].coordinate);
  return bounds;
}

// Whether some point of one set is nearer than sqrt(limit) to some point of another. Halves the wider set until boxes
// or few enough pairs decide, so that two dense cells just out of reach do not cost the product of their sizes.
class PairSearch {
 public:
  explicit PairSearch(float limit) : limit_(limit) {}

  template <class Key>
  bool any(const Cells<Key>& cells, Range a, Range b) {
    if (a.size() * b.size() <= kFewPairs) {
      for (int64_t i = a.begin; i < a.end; ++i) {
        const float q[3] = {cells.x[i], cells.y[i], cells.z[i]};
        if (count_near(cells, b, q, limit_, 1)) return true;
      }
      return false;
    }
    copy(cells, a, a_);
    copy(cells, b, b_);
    return any({0, a.size()}, {0, b.size()});
  }

 private:
  static constexpr int64_t kFewPairs = 1024;

  template <class Key>
  static void copy(const Cells<Key>& cells, Range range, std::vector<CellPoint>& points) {
    points.clear();
    for (int64_t i = range.begin; i < range.end; ++i) points.push_back({{cells.x[i], cells.y[i], cells.z[i]}});
  }

  bool any(Range a, Range b) {
    const math::Bounds box_a = box_around(a_, a), box_b = box_around(b_, b);
    if (!(math::squared_gap(box_a, box_b) < limit_)) return false;
    if (a.size() * b.size() <= kFewPairs) return any_of_all(a, b);
    const int axis_a = box_a.longest_axis(), axis_b = box_b.longest_axis();
    const float width_a = box_a.length(axis_a), width_b = box_b.length(axis_b);
    if (width_a == 0 && width_b == 0) return true;  // copies of one point on both sides: the gap is their distance
    if (width_a >= width_b) {
      const int64_t middle = halve(a_, a, axis_a);
      return any({a.begin, middle}, b) || any({middle, a.end}, b);
    }
    const int64_t middle = halve(b_, b, axis_b);
    return any(a, {b.begin, middle}) || any(a, {middle, b.end});
  }

  bool any_of_all(Range a, Range b) const {
    for (int64_t i = a.begin; i < a.end; ++i)
      for (int64_t j = b.begin; j < b.end; ++j) {
        const float *p = a_[i].coordinate, *q = b_[j].coordinate;
        if (math::squared_distance(p[0], p[1], p[2], q[0], q[1], q[2]) < limit_) return true;
      }
    return false;
  }

  static int64_t halve(std::vector<CellPoint>& points, Range range, int axis) {
    const int64_t middle = range.begin + range.size() / 2;
    std::nth_element(
        points.begin() + range.begin, points.begin() + middle, points.begin() + range.end,
        [axis](const CellPoint& p, const CellPoint& q) { return p.coordinate[axis] < q.coordinate[axis]; });
    return middle;
  }

  const float limit_;
  std::vector<CellPoint> a_, b_;
};

}  // namespace pc::cells
