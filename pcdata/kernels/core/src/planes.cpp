// Planes through triples of points, how many points are near each, and marking what is near one; for batches of clouds.
#include "pc/memory.hpp"
#include "pc/planes/plane_sums.hpp"
#include "pc/threads.hpp"

namespace pc::planes {
namespace {

constexpr int kTogether = 4;  // planes per load of a point: four times four coefficients fit 32 registers
// Points that one thread takes at a time: 1000 hypotheses on them take about 2 ms.
constexpr int64_t kCountedPiece = 8 * PointBlock::kSize;

// Which of the points [begin, end) are near a plane.
void mark_near(const float* points, int64_t begin, int64_t end, const Plane& plane, float distance, uint8_t* near) {
  for (int64_t i = begin; i < end; ++i) near[i] = plane.is_near(points + 3 * i, distance);
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

}  // namespace
}  // namespace pc::planes

PC_EXPORT int32_t pc_planes_of_triples(const pc_context* context, const float* points, const int64_t* ptr,
                                       int64_t num_clouds, const int64_t* triples, int64_t count, const int64_t* which,
                                       double flat, double* planes) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    constexpr int64_t kPlanes = 1 << 14;  // that one thread makes at a time
    const int64_t clouds = std::max<int64_t>(1, kPlanes / std::max<int64_t>(1, count));
    parallel_for(*context, num_clouds, clouds, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t cloud = first; cloud < last; ++cloud) {
        const float* own = points + 3 * ptr[cloud];
        const int64_t* triple = triples + 3 * count * which[cloud];
        for (int64_t h = 0; h < count; ++h, triple += 3)
          math::plane_through(math::vector_of(own + 3 * triple[0]), math::vector_of(own + 3 * triple[1]),
                              math::vector_of(own + 3 * triple[2]), flat, planes + 4 * (cloud * count + h));
      }
    });
  });
}

PC_EXPORT int32_t pc_count_near_planes(const pc_context* context, const float* points, const int64_t* ptr,
                                       int64_t num_clouds, const float* planes, int64_t num_planes, double distance,
                                       int64_t* counts) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    ScratchFrame scratch;
    const auto* all = reinterpret_cast<const Plane*>(planes);
    const auto pieces = cut_clouds(ptr, num_clouds, kCountedPiece);
    const auto num_pieces = static_cast<int64_t>(pieces.size());
    int64_t* own = scratch.take<int64_t>(num_pieces * num_planes);  // (piece, plane)
    constexpr int64_t kPieceRows = kCountedPiece / 4;
    for_each_piece(*context, pieces, kPieceRows, [&](const CloudPiece& piece, int64_t number) {
      int64_t* to = own + number * num_planes;
      std::fill_n(to, num_planes, 0);
      count_piece(points, piece.begin, piece.end, all + piece.cloud * num_planes, num_planes,
                  static_cast<float>(distance), to);
    });
    std::fill_n(counts, num_clouds * num_planes, 0);
    for (int64_t p = 0; p < num_pieces; ++p) {
      int64_t* to = counts + pieces[static_cast<size_t>(p)].cloud * num_planes;
      for (int64_t h = 0; h < num_planes; ++h) to[h] += own[p * num_planes + h];
    }
  });
}

PC_EXPORT int32_t pc_near_planes(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                                 const float* planes, double distance, uint8_t* near) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    for_each_piece(*context, cut_clouds(ptr, num_clouds, kCountedPiece), kCountedPiece,
                   [&](const CloudPiece& piece, int64_t) {
                     const float* plane = planes + 4 * piece.cloud;
                     mark_near(points, piece.begin, piece.end, {plane[0], plane[1], plane[2], plane[3]},
                               static_cast<float>(distance), near);
                   });
  });
}
