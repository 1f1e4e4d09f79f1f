// Refitting planes to the points near them; for batches of clouds.
#include "pc/planes/clouds.hpp"
#include "pc/planes/refinement.hpp"

PC_EXPORT int32_t pc_refine_planes(const pc_context* context, const float* points, const int64_t* ptr,
                                   int64_t num_clouds, const int64_t* run_ptr, const float* runs, double distance,
                                   const double* up, double max_tilt, double flat, int64_t rounds, double* planes,
                                   uint8_t* near) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const RefinementRules rules{static_cast<float>(distance), flat, max_tilt, rounds};
    const auto refine = [&](const pc_context& own_context, int64_t cloud) {
      ScratchFrame scratch;
      const Range rows{ptr[cloud], ptr[cloud + 1]};
      Range own = run_ptr == nullptr ? Range{0, 0} : Range{run_ptr[cloud], run_ptr[cloud + 1]};
      const float* facts = runs;
      int64_t stride = run_ptr == nullptr ? 0 : run_ptr[num_clouds];
      if (own.size() == 0) {
        stride = runs_of(rows.size());
        own = {0, stride};
        auto* mine = scratch.take<float>(kFacts * stride);
        for (int64_t run = 0; run < stride; ++run)
          bound_run(points + 3 * rows.begin, rows.size(), run, mine + run, stride);
        facts = mine;
      }
      const Runs known(facts, stride, own, points, rows);
      Refinement(own_context, known, rules, up == nullptr ? nullptr : up + 3 * cloud)
          .run(planes + 4 * cloud, near + rows.begin, scratch);
    };
    for_each_cloud(*context, ptr, num_clouds, 16, refine);
  });
}
