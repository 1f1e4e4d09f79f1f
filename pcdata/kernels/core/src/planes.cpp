// Planes through triples of points, and marking what is near one; for batches of clouds.
#include "pc/planes/runs.hpp"

namespace pc::planes {
namespace {

// Points that one thread marks at a time, whole groups of runs.
constexpr int64_t kMarkedRows = 8 * PointBlock::kSize;

// Which of the points [begin, end) are near a plane.
void mark_near(const float* points, int64_t begin, int64_t end, const Plane& plane, float distance, uint8_t* near) {
  for (int64_t i = begin; i < end; ++i) near[i] = plane.is_near(points + 3 * i, distance);
}

// The same of the points that lie in runs.
void mark_near_runs(const Runs& runs, int64_t begin, int64_t end, const Plane& plane, float distance, uint8_t* near) {
  const RunTest test(plane, distance);
  for (int64_t i = begin; i < end; i += kLanes) {
    const RunMasks masks = test(runs, i);
    const uint32_t inside = masks.inside.bits(), open = masks.open.bits();
    for (int64_t lane = 0; lane < kLanes; ++lane) {
      const int64_t run = i + lane, size = static_cast<int64_t>(runs.size[run]);
      uint8_t* to = near + kRun * run;
      if (!(open >> lane & 1)) {
        std::fill_n(to, size, uint8_t{0});
      } else if (inside >> lane & 1) {
        std::fill_n(to, size, uint8_t{1});
      } else {
        mark_near(runs.points, kRun * run, kRun * run + size, plane, distance, near);
      }
    }
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

PC_EXPORT int32_t pc_bound_runs(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                                const int64_t* run_ptr, float* runs) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const int64_t num_runs = run_ptr[num_clouds];
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud)
      parallel_for(*context, run_ptr[cloud + 1] - run_ptr[cloud], 256, [&](int64_t begin, int64_t end, int64_t) {
        for (int64_t r = begin; r < end; ++r)
          bound_run(points + 3 * ptr[cloud], ptr[cloud + 1] - ptr[cloud], r, runs + run_ptr[cloud] + r, num_runs);
      });
  });
}

PC_EXPORT int32_t pc_near_planes(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                                 const int64_t* run_ptr, const float* runs, const float* planes, double distance,
                                 uint8_t* near) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const auto limit = static_cast<float>(distance);
    const auto* all = reinterpret_cast<const Plane*>(planes);
    for_each_piece(
        *context, cut_clouds(ptr, num_clouds, kMarkedRows), kMarkedRows, [&](const CloudPiece& piece, int64_t) {
          const int64_t own = piece.cloud;
          if (run_ptr == nullptr || run_ptr[own] == run_ptr[own + 1]) {
            mark_near(points, piece.begin, piece.end, all[own], limit, near);
            return;
          }
          const Runs mine(runs, run_ptr[num_clouds], {run_ptr[own], run_ptr[own + 1]}, points,
                          {ptr[own], ptr[own + 1]});
          const int64_t first = (piece.begin - ptr[own]) / kRun;  // pieces are whole groups of runs
          mark_near_runs(mine, first, first + runs_of(piece.end - piece.begin), all[own], limit, near + ptr[own]);
        });
  });
}
