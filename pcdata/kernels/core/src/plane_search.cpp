// The search for planes that stops once a better one is unlikely to be missed; for batches of clouds.
#include "pc/planes/clouds.hpp"
#include "pc/planes/tries.hpp"

PC_EXPORT int32_t pc_search_planes(const pc_context* context, const float* points, const int64_t* ptr,
                                   int64_t num_clouds, int64_t bits, const float* planes, const uint8_t* competes,
                                   int64_t num_planes, double distance, double missed, int64_t not_drawn,
                                   int64_t* counts) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const auto* all = reinterpret_cast<const Plane*>(planes);
    const Chance chance{distance, missed, not_drawn};
    const auto find = [&](const pc_context& own_context, int64_t cloud) {
      ScratchFrame scratch;
      const ScoredPoints some(points + 3 * ptr[cloud], ptr[cloud + 1] - ptr[cloud], bits, scratch);
      const int64_t at = cloud * num_planes;
      std::fill_n(counts + at, num_planes, 0);
      Tries(own_context, some, chance)
          .run(
              all + at, competes + at, num_planes, [](int64_t, int64_t) {},
              [&](int64_t plane, int64_t count) { counts[at + plane] = count; });
    };
    for_each_cloud(*context, ptr, num_clouds, 16, find);
  });
}
