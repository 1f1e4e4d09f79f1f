// Farthest point sampling of ragged batches.
#include "pc/rows/kept_points.hpp"
#include "pc/sampling/groups.hpp"
#include "pc/sampling/picks.hpp"

namespace pc::sampling {
namespace {

constexpr int64_t kGroupsPerPiece = 8;
// Leaves visited before Ctrl-C is looked for: about 50 ms at 25 ns each.
constexpr int64_t kBudget = int64_t{1} << 21;

// `room`: where its points start among those of all clouds.
void start(FarthestSampler& sampler, sort::MortonPoints& order, int64_t room) {
  order.serial(sampler.points(), sampler.count(), room,
               [&](const sort::PlacedPoint* points, int64_t count, int64_t at) { sampler.place(points, count, at); });
  sampler.start_leaf_groups(0, sampler.num_leaf_groups());
  sampler.start_levels();
}

void start_in_parallel(const pc_context& context, ScratchFrame& scratch, FarthestSampler& sampler) {
  PointGroups groups(context, scratch, sampler);
  const bool in_groups = groups.put_in_order();
  if (!in_groups) {
    sort::MortonPoints order(scratch, sampler.count());
    order.parallel(
        context, scratch, sampler.points(), sampler.count(),
        [&](const sort::PlacedPoint* points, int64_t count, int64_t at) { sampler.place(points, count, at); });
  }
  parallel_for(context, sampler.num_leaf_groups(), kGroupsPerPiece, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t group = begin; group < end; ++group) {
      if (in_groups) groups.place(group, group + 1);
      sampler.start_leaf_groups(group, group + 1);
    }
  });
  sampler.start_levels();
}

void sample(const pc_context& context, const float* points, const int64_t* ptr, int64_t num_clouds,
            const int64_t* wanted, int64_t* picks) {
  ScratchFrame scratch;
  std::vector<Picking<FarthestSampler>> open;
  std::vector<int64_t> rooms;
  int64_t room = 0;
  for (int64_t cloud = 0; cloud < num_clouds; picks += wanted[cloud++]) {
    if (wanted[cloud] == 0) continue;
    const int64_t count = ptr[cloud + 1] - ptr[cloud];
    open.push_back({FarthestSampler(scratch, points + 3 * ptr[cloud], count), picks, wanted[cloud]});
    rooms.push_back(room);
    room += count;
  }
  if (open.size() == 1) {
    start_in_parallel(context, scratch, open[0].sampler);
  } else {
    sort::MortonPoints order(scratch, room);
    parallel_for(context, static_cast<int64_t>(open.size()), 1, [&](int64_t i, int64_t, int64_t) {
      const auto own = static_cast<size_t>(i);
      start(open[own].sampler, order, rooms[own]);
    });
  }
  take_picks(context, open, kBudget);
}

}  // namespace
}  // namespace pc::sampling

PC_EXPORT int32_t pc_farthest_points(const pc_context* context, const float* points, const int64_t* ptr,
                                     int64_t num_clouds, const uint8_t* within, int64_t num_rows, const int64_t* wanted,
                                     int64_t* picks, int64_t* rows) {
  using namespace pc;
  using namespace pc::sampling;
  return guarded([&] {
    if (within == nullptr) return sample(*context, points, ptr, num_clouds, wanted, picks);
    ScratchFrame scratch;
    const auto kept = pc::rows::gather_kept_points(*context, scratch, points, within, num_rows, ptr[num_clouds]);
    sample(*context, kept.points, ptr, num_clouds, wanted, picks);
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud)
      for (int64_t k = 0; k < wanted[cloud]; ++k) *rows++ = kept.rows[ptr[cloud] + *picks++];
  });
}
