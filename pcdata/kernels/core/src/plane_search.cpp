// The search for a plane that stops once a better one is unlikely to be missed, on some of the points of large clouds.
#include <cmath>

#include "pc/planes/scored_points.hpp"

namespace pc::planes {
namespace {

constexpr int64_t kTries = 32;  // planes counted before it is looked whether they are enough
constexpr int64_t kBlocks = 8;  // of points, that one thread takes at a time; a small cloud has no more

struct Chance {
  double distance, missed;  // log(1 - probability)
  int64_t not_drawn;        // of the first planes
};

// Count the points near some planes, kTries at most.
void count_tries(const pc_context& context, const ScoredPoints& points, const Plane* planes, int64_t some,
                 float distance, int64_t* counts) {
  const int64_t pieces = (points.num_blocks() + kBlocks - 1) / kBlocks;
  std::vector<int64_t> own(static_cast<size_t>(pieces * kTries), 0);
  parallel_for(context, points.num_blocks(), kBlocks, [&](int64_t begin, int64_t end, int64_t) {
    int64_t* to = own.data() + begin / kBlocks * kTries;
    for (int64_t b = begin; b < end; ++b) count_near_all(points.block(b), planes, some, distance, to);
  });
  std::fill_n(counts, some, 0);
  for (int64_t piece = 0; piece < pieces; ++piece)
    for (int64_t h = 0; h < some; ++h) counts[h] += own[static_cast<size_t>(piece * kTries + h)];
}

void search(const pc_context& context, const ScoredPoints& points, const Plane* planes, const uint8_t* competes,
            int64_t num_planes, const Chance& chance, int64_t* counts) {
  std::fill_n(counts, num_planes, 0);
  int64_t best = 0;
  const auto size = static_cast<double>(points.size());
  for (int64_t first = 0; first < num_planes; first += kTries) {
    int64_t found[kTries];
    const int64_t some = std::min(kTries, num_planes - first);
    count_tries(context, points, planes + first, some, static_cast<float>(chance.distance), found);
    for (int64_t k = 0; k < some; ++k) {
      const int64_t at = first + k;
      if (competes[at] && found[k] > best) best = counts[at] = found[k];
      const double share = static_cast<double>(best) / size;
      const double needed = chance.missed / std::log1p(-(share * share * share));
      if (static_cast<double>(at + 1 - chance.not_drawn) >= needed) return;
    }
  }
}

}  // namespace
}  // namespace pc::planes

PC_EXPORT int32_t pc_search_planes(const pc_context* context, const float* points, const int64_t* ptr,
                                   int64_t num_clouds, int64_t bits, const float* planes, const uint8_t* competes,
                                   int64_t num_planes, double distance, double missed, int64_t not_drawn,
                                   int64_t* counts) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const auto* all = reinterpret_cast<const Plane*>(planes);
    const Chance chance{distance, missed, not_drawn};
    const auto find = [&](int64_t cloud) {
      ScratchFrame scratch;
      const ScoredPoints some(points + 3 * ptr[cloud], ptr[cloud + 1] - ptr[cloud], bits, scratch);
      const int64_t at = cloud * num_planes;
      search(*context, some, all + at, competes + at, num_planes, chance, counts + at);
    };
    // Small clouds side by side, each by one thread.
    const auto is_small = [&](int64_t cloud) { return ptr[cloud + 1] - ptr[cloud] <= kBlocks * PointBlock::kSize; };
    parallel_for(*context, num_clouds, 16, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t cloud = begin; cloud < end; ++cloud)
        if (is_small(cloud)) find(cloud);
    });
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud)
      if (!is_small(cloud)) find(cloud);
  });
}
