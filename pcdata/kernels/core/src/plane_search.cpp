// The search for a plane that stops once a better one is unlikely to be missed, on some of the points of large clouds.
#include <cmath>

#include "pc/memory.hpp"
#include "pc/planes/plane_sums.hpp"
#include "pc/threads.hpp"

namespace pc::planes {
namespace {

constexpr int64_t kTries = 32;  // planes counted before it is looked whether they are enough
constexpr int64_t kBlocks = 8;  // of points, that one thread takes at a time; a small cloud has no more

struct Chance {
  double distance, missed;  // log(1 - probability)
  int64_t not_drawn;        // of the first planes
};

// The points of a cloud that planes are scored on: all, or one out of each of 2^bits stretches, as the reference says.
class ScoredPoints {
 public:
  ScoredPoints(const float* points, int64_t count, int64_t bits, ScratchFrame& scratch) {
    const bool is_all = bits > 40 || count <= int64_t{1} << bits;
    size_ = is_all ? count : int64_t{1} << bits;
    num_blocks_ = (size_ + PointBlock::kSize - 1) / PointBlock::kSize;
    blocks_ = scratch.take<PointBlock>(num_blocks_);
    for (int64_t b = 0; b < num_blocks_; ++b) {
      const int64_t begin = b * PointBlock::kSize, end = std::min(size_, begin + PointBlock::kSize);
      if (is_all) {
        blocks_[b].read(points, begin, end);
        continue;
      }
      float some[3 * PointBlock::kSize];
      for (int64_t i = begin; i < end; ++i) {
        const int64_t first = i * count >> bits, after = (i + 1) * count >> bits;
        const int64_t part = i * 2654435769 & 0xFFFFFFFF;
        std::memcpy(some + 3 * (i - begin), points + 3 * (first + (part * (after - first) >> 32)), 3 * sizeof(float));
      }
      blocks_[b].read(some, 0, end - begin);
    }
  }

  int64_t size() const { return size_; }

  // Count the points near some planes, kTries at most.
  void count(const pc_context& context, const Plane* planes, int64_t some, float distance, int64_t* counts) const {
    const int64_t pieces = (num_blocks_ + kBlocks - 1) / kBlocks;
    std::vector<int64_t> own(static_cast<size_t>(pieces * kTries), 0);
    parallel_for(context, num_blocks_, kBlocks, [&](int64_t begin, int64_t end, int64_t) {
      int64_t* to = own.data() + begin / kBlocks * kTries;
      for (int64_t b = begin; b < end; ++b) count_near_all(blocks_[b], planes, some, distance, to);
    });
    std::fill_n(counts, some, 0);
    for (int64_t piece = 0; piece < pieces; ++piece)
      for (int64_t h = 0; h < some; ++h) counts[h] += own[static_cast<size_t>(piece * kTries + h)];
  }

 private:
  int64_t size_, num_blocks_;
  PointBlock* blocks_;
};

void search(const pc_context& context, const ScoredPoints& points, const Plane* planes, const uint8_t* competes,
            int64_t num_planes, const Chance& chance, int64_t* counts) {
  std::fill_n(counts, num_planes, 0);
  int64_t best = 0;
  const auto size = static_cast<double>(points.size());
  for (int64_t first = 0; first < num_planes; first += kTries) {
    int64_t found[kTries];
    const int64_t some = std::min(kTries, num_planes - first);
    points.count(context, planes + first, some, static_cast<float>(chance.distance), found);
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
