// Planes through triples of points, how many points are near each, and marking what is near one; for batches of clouds.
#include <cmath>

#include "pc/pieces.hpp"
#include "pc/planes/plane_sums.hpp"

namespace pc {
namespace {

constexpr int kTogether = 4;  // planes per load of a point: four times four coefficients fit 32 registers
// Points that one thread takes at a time: 1000 hypotheses on them take about 2 ms.
constexpr int64_t kPiece = 8 * PointBlock::kSize;

// Which of the points [begin, end) are near a plane.
void mark_near(const float* points, int64_t begin, int64_t end, const Plane& plane, float distance, uint8_t* near) {
  for (int64_t i = begin; i < end; ++i) {
    const float* p = points + 3 * i;
    near[i] = std::fabs(((plane.x * p[0] + plane.y * p[1]) + plane.z * p[2]) + plane.d) < distance;
  }
}

// Counts of all planes on points [begin, end).
void count_piece(const float* points, int64_t begin, int64_t end, const Plane* planes, int64_t num_planes,
                 float distance, int64_t* counts) {
  PointBlock block;
  for (int64_t i = begin; i < end; i += PointBlock::kSize) {
    block.read(points, i, std::min<int64_t>(end, i + PointBlock::kSize));
    int64_t h = 0;
    for (; h + kTogether <= num_planes; h += kTogether) count_near<kTogether>(block, planes + h, distance, counts + h);
    for (; h < num_planes; ++h) count_near<1>(block, planes + h, distance, counts + h);
  }
}

struct Vector {
  double x, y, z;

  explicit Vector(const float* p) : x(p[0]), y(p[1]), z(p[2]) {}
  Vector(double a, double b, double c) : x(a), y(b), z(c) {}
  Vector operator-(const Vector& other) const { return {x - other.x, y - other.y, z - other.z}; }
  Vector cross(const Vector& other) const {
    return {y * other.z - z * other.y, z * other.x - x * other.z, x * other.y - y * other.x};
  }
  // Fused, as torch's norm of a row is.
  double length() const { return std::sqrt(std::fma(z, z, std::fma(y, y, x * x))); }
  double largest() const { return std::max(std::fabs(x), std::max(std::fabs(y), std::fabs(z))); }
};

// The plane through three points, with the float64 operations of the reference; NaN where they cannot be told from a
// line: their triangle is lower than `flat` of the largest coordinate.
void plane_through(const Vector& a, const Vector& b, const Vector& c, double flat, double* plane) {
  const Vector normal = (b - a).cross(c - a);
  const double length = normal.length();
  const double longest = std::max((b - a).length(), std::max((c - a).length(), (c - b).length()));
  const double largest = std::max(a.largest(), std::max(b.largest(), c.largest()));
  if (!(length > longest * (flat * largest))) {
    std::fill_n(plane, 4, std::numeric_limits<double>::quiet_NaN());
    return;
  }
  plane[0] = normal.x / length;
  plane[1] = normal.y / length;
  plane[2] = normal.z / length;
  plane[3] = -((plane[0] * a.x + plane[1] * a.y) + plane[2] * a.z);
}

}  // namespace
}  // namespace pc

// points (N, 3), ptr (num_clouds+1,), triples (T, count, 3) of rows within a cloud, which (num_clouds,) of the T each
// cloud takes -> planes (num_clouds, count, 4); NaN for triples on a line.
PC_EXPORT int32_t pc_planes_of_triples(const pc_context* context, const float* points, const int64_t* ptr,
                                       int64_t num_clouds, const int64_t* triples, int64_t count, const int64_t* which,
                                       double flat, double* planes) {
  return pc::guarded([&] {
    constexpr int64_t kPlanes = 1 << 14;  // that one thread makes at a time
    const int64_t clouds = std::max<int64_t>(1, kPlanes / std::max<int64_t>(1, count));
    pc::parallel_for(*context, num_clouds, clouds, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t cloud = first; cloud < last; ++cloud) {
        const float* own = points + 3 * ptr[cloud];
        const int64_t* triple = triples + 3 * count * which[cloud];
        for (int64_t h = 0; h < count; ++h, triple += 3)
          pc::plane_through(pc::Vector(own + 3 * triple[0]), pc::Vector(own + 3 * triple[1]),
                            pc::Vector(own + 3 * triple[2]), flat, planes + 4 * (cloud * count + h));
      }
    });
  });
}

// points (N, 3), ptr (num_clouds+1,), planes (num_clouds, H, 4) -> counts (num_clouds, H): the points of each cloud with
// |((nx*x + ny*y) + nz*z) + d| < distance.
PC_EXPORT int32_t pc_count_near_planes(const pc_context* context, const float* points, const int64_t* ptr,
                                       int64_t num_clouds, const float* planes, int64_t num_planes, double distance,
                                       int64_t* counts) {
  return pc::guarded([&] {
    pc::ScratchFrame scratch;
    const auto* all = reinterpret_cast<const pc::Plane*>(planes);
    const auto pieces = pc::cut_clouds(ptr, num_clouds, pc::kPiece);
    const auto num_pieces = static_cast<int64_t>(pieces.size());
    int64_t* own = scratch.take<int64_t>(num_pieces * num_planes);  // (piece, plane)
    constexpr int64_t kPieceRows = pc::kPiece / 4;
    pc::for_each_piece(*context, pieces, kPieceRows, [&](const pc::CloudPiece& piece, int64_t number) {
      int64_t* to = own + number * num_planes;
      std::fill_n(to, num_planes, 0);
      pc::count_piece(points, piece.begin, piece.end, all + piece.cloud * num_planes, num_planes,
                      static_cast<float>(distance), to);
    });
    std::fill_n(counts, num_clouds * num_planes, 0);
    for (int64_t p = 0; p < num_pieces; ++p) {
      int64_t* to = counts + pieces[static_cast<size_t>(p)].cloud * num_planes;
      for (int64_t h = 0; h < num_planes; ++h) to[h] += own[p * num_planes + h];
    }
  });
}

// points (N, 3), ptr (num_clouds+1,), planes (num_clouds, 4) -> near (N,), 0 or 1: whether a point is near its cloud's.
PC_EXPORT int32_t pc_near_planes(const pc_context* context, const float* points, const int64_t* ptr,
                                 int64_t num_clouds, const float* planes, double distance, uint8_t* near) {
  return pc::guarded([&] {
    pc::for_each_piece(*context, pc::cut_clouds(ptr, num_clouds, pc::kPiece), pc::kPiece,
                       [&](const pc::CloudPiece& piece, int64_t) {
                         const float* plane = planes + 4 * piece.cloud;
                         pc::mark_near(points, piece.begin, piece.end, {plane[0], plane[1], plane[2], plane[3]},
                                       static_cast<float>(distance), near);
                       });
  });
}
