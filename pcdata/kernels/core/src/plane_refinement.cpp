// Refitting planes to the points near them; for batches of clouds.
#include "pc/planes/clouds.hpp"
#include "pc/planes/refinement.hpp"

PC_EXPORT int32_t pc_refine_planes(const pc_context* context, const float* points, const int64_t* ptr,
                                   int64_t num_clouds, double distance, const double* up, double max_tilt, double flat,
                                   int64_t rounds, double* planes, uint8_t* near) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const RefinementRules rules{static_cast<float>(distance), flat, max_tilt, rounds};
    const auto refine = [&](const pc_context& own_context, int64_t cloud) {
      ScratchFrame scratch;
      const Runs runs = bound_runs(own_context, points + 3 * ptr[cloud], ptr[cloud + 1] - ptr[cloud], scratch);
      Refinement(own_context, runs, rules, up == nullptr ? nullptr : up + 3 * cloud)
          .run(planes + 4 * cloud, near + ptr[cloud], scratch);
    };
    for_each_cloud(*context, ptr, num_clouds, 16, refine);
  });
}
