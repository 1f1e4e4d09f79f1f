// The beginnings of random permutations of the rows of many clouds.
#include "pc/math/random.hpp"
#include "pc/sort/radix.hpp"

namespace pc::noise {
namespace {

constexpr int64_t kCloudsPerPiece = 64;
constexpr int64_t kRowsPerPiece = 1 << 14;
constexpr int64_t kRadixFrom = 512;  // fewer are faster by comparison
constexpr int kBinBits = 11;
constexpr int64_t kBins = 1 << kBinBits;

// Rows are sorted by the upper half of their words, and by themselves where those are equal.
struct DrawnRow {
  uint32_t key, row;

  bool operator<(const DrawnRow& other) const { return key != other.key ? key < other.key : row < other.row; }
};

uint32_t drawn_key(uint64_t seed, int64_t row) {
  return static_cast<uint32_t>(math::random_word(seed, static_cast<uint64_t>(row)) >> 32);
}

// The rows of a cloud that come first, in any order, a few more than wanted: those of the lowest bins of keys.
int64_t choose_first(uint64_t seed, int64_t count, int64_t wanted, uint32_t* keys, DrawnRow* chosen) {
  std::vector<int64_t> bins(kBins, 0);
  for (int64_t row = 0; row < count; ++row) keys[row] = drawn_key(seed, row);
  for (int64_t row = 0; row < count; ++row) ++bins[static_cast<size_t>(keys[row] >> (32 - kBinBits))];
  uint32_t last = 0;
  for (int64_t sum = bins[0]; sum < wanted; sum += bins[last]) ++last;
  const uint32_t limit = ((last + 1) << (32 - kBinBits)) - 1;
  int64_t taken = 0;
  for (int64_t row = 0; row < count; ++row)
    if (keys[row] <= limit) chosen[taken++] = {keys[row], static_cast<uint32_t>(row)};
  return taken;
}

// Write the first `wanted` rows of a permutation of [first, first + count).
void permute(const pc_context& context, uint64_t seed, int64_t first, int64_t count, int64_t wanted, int64_t* rows) {
  require_numbered(count);
  ScratchFrame scratch;
  const bool choose = wanted < count / 4;
  DrawnRow* drawn = scratch.take<DrawnRow>(count);
  int64_t number = count;
  if (choose) {
    number = choose_first(seed, count, wanted, scratch.take<uint32_t>(count), drawn);
  } else {
    parallel_for(context, count, kRowsPerPiece, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t row = begin; row < end; ++row) drawn[row] = {drawn_key(seed, row), static_cast<uint32_t>(row)};
    });
  }
  if (number < kRadixFrom)
    std::sort(drawn, drawn + number);
  else  // stable, and the rows rise
    drawn = sort::radix_sort(context, scratch, drawn, scratch.take<DrawnRow>(number), even_pieces(context, number), 32);
  for (int64_t i = 0; i < wanted; ++i) rows[i] = first + drawn[i].row;
}

}  // namespace
}  // namespace pc::noise

PC_EXPORT int32_t pc_random_order(const pc_context* context, int64_t num_clouds, const int64_t* counts,
                                  const int64_t* wanted, const int64_t* seeds, int64_t* rows) {
  using namespace pc;
  using namespace pc::noise;
  return guarded([&] {
    std::vector<int64_t> starts(static_cast<size_t>(num_clouds)), places(static_cast<size_t>(num_clouds));
    for (size_t cloud = 1; cloud < starts.size(); ++cloud) {
      starts[cloud] = starts[cloud - 1] + counts[cloud - 1];
      places[cloud] = places[cloud - 1] + wanted[cloud - 1];
    }
    const auto permute_cloud = [&](const pc_context& own, int64_t cloud) {
      const auto c = static_cast<size_t>(cloud);
      if (wanted[c] > 0)
        permute(own, static_cast<uint64_t>(seeds[c]), starts[c], counts[c], wanted[c], rows + places[c]);
    };
    if (num_clouds == 1) return permute_cloud(*context, 0);
    const pc_context alone{1, nullptr};
    const int64_t each = std::max<int64_t>(1, (starts.empty() ? 0 : starts.back()) / std::max<int64_t>(1, num_clouds));
    const int64_t grain = std::max<int64_t>(1, std::min(kCloudsPerPiece, kRowsPerPiece / each));
    parallel_for(*context, num_clouds, grain, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t cloud = begin; cloud < end; ++cloud) permute_cloud(alone, cloud);
    });
  });
}
