// The convex hull of points in a plane.
#include "pc/planes/hull.hpp"

PC_EXPORT int32_t pc_convex_hull(const pc_context* context, const double* points, int64_t count, int64_t* corners,
                                 int64_t* num_corners) {
  using namespace pc;
  return guarded([&] { *num_corners = outline::convex_hull(*context, points, count, corners); });
}
