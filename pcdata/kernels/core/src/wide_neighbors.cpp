// Nearest neighbors among points of any number of columns, exact, on ragged batches.
#include <cmath>
#include <type_traits>

#include "pc/neighbors/nearest_keys.hpp"
#include "pc/wide/search.hpp"

namespace pc::wide {
namespace {

using neighbors::kNoId;
using neighbors::NearestKeys;
using neighbors::NearestMany;
using neighbors::NearKey;

struct Wanted {
  int64_t k;
  float limit;      // neighbors have d <= limit, or d2 of straight ones
  int64_t missing;  // the row of a neighbor that is not there
  int64_t* index;   // (Q, k)
  float* distance;  // (Q, k)
};

template <class Norm, class Nearest>
void write(const Wanted& wanted, const QueryGroup<Norm>& group, const uint32_t* rows, const Nearest& nearest) {
  constexpr bool kIsSquared = std::is_same_v<Norm, Straight>;
  for (PackMask left = group.active(); left != 0; left &= left - 1) {
    const int lane = __builtin_ctz(left);
    const int64_t start = int64_t{rows[lane]} * wanted.k;
    for (int64_t i = 0; i < wanted.k; ++i) {
      const uint64_t key = nearest.key(static_cast<int>(i), lane);
      const bool real = NearKey::id(key) != kNoId;
      wanted.index[start + i] = real ? int64_t{NearKey::id(key)} : wanted.missing;
      const float found = NearKey::squared(key);
      wanted.distance[start + i] = !real ? kInfinity : kIsSquared ? std::sqrt(found) : found;
    }
  }
}

template <class Norm, class Nearest>
void find(const pc_context& context, const std::vector<Tree>& points, const std::vector<Tree>& queries, int64_t width,
          const Wanted& wanted) {
  struct Work {
    size_t cloud;
    int64_t leaf;
  };
  std::vector<Work> work;
  for (size_t b = 0; b < queries.size(); ++b)
    for (int64_t leaf = 0; leaf < queries[b].num_leaves(); ++leaf) work.push_back({b, leaf});
  // A group of sixteen looks at every leaf of its cloud where nothing can be passed by: a few milliseconds.
  parallel_for(context, static_cast<int64_t>(work.size()), 8, [&](int64_t begin, int64_t end, int64_t) {
    QueryGroup<Norm> group(width);
    Nearest nearest;
    for (int64_t i = begin; i < end; ++i) {
      const Work& one = work[static_cast<size_t>(i)];
      group.take(queries[one.cloud], one.leaf);
      nearest.start(static_cast<int>(wanted.k), group.limits(wanted.limit));
      Search<Norm, Nearest>(points[one.cloud], group, nearest).run();
      nearest.finish();
      write(wanted, group, queries[one.cloud].rows(one.leaf), nearest);
    }
  });
}

template <class Norm>
void find_by(const pc_context& context, const std::vector<Tree>& points, const std::vector<Tree>& queries,
             int64_t width, const Wanted& wanted) {
  const auto search = wanted.k <= NearestKeys::kMax ? find<Norm, NearestKeys> : find<Norm, NearestMany>;
  search(context, points, queries, width, wanted);
}

}  // namespace
}  // namespace pc::wide

PC_EXPORT int32_t pc_wide_neighbors(const pc_context* context, const float* points, const int64_t* ptr,
                                    int64_t num_clouds, int64_t width, const float* queries, const int64_t* queries_ptr,
                                    int64_t k, double limit, int64_t norm, int64_t* index, float* distance) {
  using namespace pc;
  using namespace pc::wide;
  return guarded([&] {
    ScratchFrame scratch;
    const std::vector<Tree> trees = build_trees(*context, scratch, {points, ptr, num_clouds, width});
    std::vector<Tree> own;
    if (queries != nullptr) own = build_trees(*context, scratch, {queries, queries_ptr, num_clouds, width});
    const Wanted wanted{k, static_cast<float>(limit), ptr[num_clouds], index, distance};
    const auto search = norm == 0 ? find_by<Straight> : norm == 1 ? find_by<Summed> : find_by<Largest>;
    search(*context, trees, queries == nullptr ? trees : own, width, wanted);
  });
}
