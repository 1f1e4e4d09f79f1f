// Which of many planes have more points near them than all before; for batches of clouds.
#include "pc/planes/clouds.hpp"
#include "pc/planes/records.hpp"

PC_EXPORT int32_t pc_record_planes(const pc_context* context, const float* points, const int64_t* ptr,
                                   int64_t num_clouds, const int64_t* run_ptr, const float* runs, const float* planes,
                                   const uint8_t* competes, int64_t num_planes, double distance, const int64_t* floors,
                                   int64_t* counts) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const auto* all = reinterpret_cast<const Plane*>(planes);
    const auto rows_of = [&](int64_t cloud) { return Range{ptr[cloud], ptr[cloud + 1]}; };
    const auto find = [&](const pc_context& own_context, int64_t cloud) {
      const Range own = run_ptr == nullptr ? Range{0, 0} : Range{run_ptr[cloud], run_ptr[cloud + 1]};
      const Runs mine(runs, run_ptr == nullptr ? 0 : run_ptr[num_clouds], own, points, rows_of(cloud));
      Records(own_context, points, rows_of(cloud), mine, all + cloud * num_planes, competes + cloud * num_planes,
              num_planes, static_cast<float>(distance), floors[cloud], counts + cloud * num_planes)
          .find();
    };
    for_each_cloud(*context, ptr, num_clouds, 16, find);
  });
}
