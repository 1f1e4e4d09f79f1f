// Farthest point sampling of ragged batches of points of any number of columns.
#include "pc/wide/farthest.hpp"

namespace pc::wide {
namespace {

// Leaves visited before Ctrl-C is looked for: about 50 ms.
constexpr int64_t kBudget = int64_t{1} << 20;

struct Task {
  Sampler sampler;
  int64_t* picks;
  int64_t wanted, taken;
};

void sample(const pc_context& context, const Clouds& clouds, const int64_t* wanted, int64_t* picks) {
  ScratchFrame scratch;
  std::vector<Task> open;
  for (int64_t b = 0; b < clouds.num_clouds; picks += wanted[b++])
    if (wanted[b] > 0)
      open.push_back({Sampler(scratch, clouds.point(clouds.ptr[b]), clouds.ptr[b + 1] - clouds.ptr[b], clouds.width),
                      picks, wanted[b], 0});
  if (open.size() == 1)
    open[0].sampler.start(context, false);
  else
    parallel_for(context, static_cast<int64_t>(open.size()), 1,
                 [&](int64_t i, int64_t, int64_t) { open[static_cast<size_t>(i)].sampler.start(context, true); });
  while (!open.empty()) {
    parallel_for(context, static_cast<int64_t>(open.size()), 1, [&](int64_t i, int64_t, int64_t) {
      Task& task = open[static_cast<size_t>(i)];
      task.taken = task.sampler.advance(task.picks, task.taken, task.wanted, kBudget);
    });
    open.erase(std::remove_if(open.begin(), open.end(), [](const Task& t) { return t.taken == t.wanted; }), open.end());
  }
}

}  // namespace
}  // namespace pc::wide

PC_EXPORT int32_t pc_wide_farthest_points(const pc_context* context, const float* points, const int64_t* ptr,
                                          int64_t num_clouds, int64_t width, const int64_t* wanted, int64_t* picks) {
  using namespace pc;
  using namespace pc::wide;
  return guarded([&] { sample(*context, {points, ptr, num_clouds, width}, wanted, picks); });
}
