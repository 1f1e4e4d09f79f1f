// Farthest point sampling of ragged batches of points of any number of columns.
#include "pc/sampling/picks.hpp"
#include "pc/wide/farthest.hpp"

namespace pc::wide {
namespace {

// Leaves visited before Ctrl-C is looked for: about 50 ms.
constexpr int64_t kBudget = int64_t{1} << 20;

void sample(const pc_context& context, const Clouds& clouds, const int64_t* wanted, int64_t* picks) {
  ScratchFrame scratch;
  std::vector<sampling::Picking<Sampler>> open;
  for (int64_t b = 0; b < clouds.num_clouds; picks += wanted[b++])
    if (wanted[b] > 0)
      open.push_back({Sampler(scratch, clouds.point(clouds.ptr[b]), clouds.ptr[b + 1] - clouds.ptr[b], clouds.width),
                      picks, wanted[b]});
  if (open.size() == 1)
    open[0].sampler.start(context, false);
  else
    parallel_for(context, static_cast<int64_t>(open.size()), 1,
                 [&](int64_t i, int64_t, int64_t) { open[static_cast<size_t>(i)].sampler.start(context, true); });
  sampling::take_picks(context, open, kBudget);
}

}  // namespace
}  // namespace pc::wide

PC_EXPORT int32_t pc_wide_farthest_points(const pc_context* context, const float* points, const int64_t* ptr,
                                          int64_t num_clouds, int64_t width, const int64_t* wanted, int64_t* picks) {
  using namespace pc;
  using namespace pc::wide;
  return guarded([&] { sample(*context, {points, ptr, num_clouds, width}, wanted, picks); });
}
