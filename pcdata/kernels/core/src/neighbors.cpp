// Nearest neighbors and neighbors within a radius, exact, on ragged batches.
#include "pc/neighbors/batch_search.hpp"
#include "pc/neighbors/nearest_keys.hpp"

namespace pc::neighbors {
namespace {

// Writes neighbors ascending by (squared distance, row); missing ones are (num_points, infinity).
struct WriteNeighbors {
  int64_t k, num_points;
  int64_t* index;   // (Q, k)
  float* distance;  // (Q, k)

  template <class Search, class Nearest>
  void operator()(const Search& search, const QueryGroup& group, const Nearest& nearest, const uint32_t* row) const {
    for (PackMask left = group.active; left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      const int64_t query = row[lane];
      for (int i = 0; i < k; ++i) {
        const uint64_t key = nearest.key(i, lane);
        const bool real = NearKey::id(key) != kNoId;
        index[query * k + i] = real ? search.row(NearKey::id(key)) : num_points;
        distance[query * k + i] = real ? std::sqrt(NearKey::squared(key)) : kInfinity;
      }
    }
  }
};

// Writes the squared distance to the nearest point, infinity where there is none.
struct WriteNearest {
  float* squared;  // (Q,)

  template <class Search>
  void operator()(const Search&, const QueryGroup& group, const NearestDistances& nearest, const uint32_t* row) const {
    alignas(64) float value[kQueries];
    nearest.squared(0).store(value);
    for (PackMask left = group.active; left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      squared[row[lane]] = value[lane];
    }
  }
};

template <class Nearest>
void find_neighbors(const pc_context& context, const Limits& limits, const Clouds& clouds, const Clouds* queries,
                    const Grid* grid, const WriteNeighbors& task) {
  BatchSearch<Nearest, WriteNeighbors> search(context, task.k, limits, task);
  if (queries != nullptr)
    search.run(clouds, *queries);
  else
    search.run(clouds, grid);
}

template <class Nearest>
void find_in_index(const pc_context& context, const Limits& limits, const Leaves& leaves, Boxes* boxes,
                   const Clouds* queries, const WriteNeighbors& task) {
  ScratchFrame scratch;
  const CloudTree* trees = lay_out_trees(scratch, leaves, boxes);
  BatchSearch<Nearest, WriteNeighbors> search(context, task.k, limits, task);
  if (queries != nullptr)
    search.run(scratch, trees, *queries);
  else
    search.by_tree(leaves, trees, leaves, nullptr);
}

}  // namespace
}  // namespace pc::neighbors

PC_EXPORT int32_t pc_neighbors(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                               const float* queries, const int64_t* queries_ptr, int64_t k, double limit,
                               const float* limits, const int64_t* pixel, int64_t width, const double* camera,
                               int64_t* index, float* distance) {
  using namespace pc;
  using namespace pc::neighbors;
  return guarded([&] {
    const Grid grid{pixel, width, camera};
    const Clouds clouds{points, ptr, num_clouds}, from{queries, queries_ptr, num_clouds};
    const WriteNeighbors task{k, ptr[num_clouds], index, distance};
    const auto find = k <= NearestKeys::kMax ? find_neighbors<NearestKeys> : find_neighbors<NearestMany>;
    find(*context, {static_cast<float>(limit), limits}, clouds, queries == nullptr ? nullptr : &from,
         pixel == nullptr ? nullptr : &grid, task);
  });
}

PC_EXPORT int32_t pc_index_points(const pc_context* context, const float* points, const int64_t* ptr,
                                  int64_t num_clouds, int64_t copies, float* leaves, int64_t* leaf_ptr, float* boxes,
                                  int64_t* kept) {
  using namespace pc;
  using namespace pc::neighbors;
  return guarded([&] {
    ScratchFrame scratch;
    LeafBuilder builder(*context, scratch, points, ptr, num_clouds);
    const int64_t* unused;
    const Leaves found = builder.without_copies(copies, unused);
    Leaf* leaf = reinterpret_cast<Leaf*>(leaves);
    std::copy_n(found.leaf, found.count(), leaf);
    std::copy_n(found.leaf_ptr, num_clouds + 1, leaf_ptr);
    const Leaves own{leaf, leaf_ptr, num_clouds};
    fill_trees(*context, lay_out_trees(scratch, own, reinterpret_cast<Boxes*>(boxes)), num_clouds);
    *kept = 0;
    for (int64_t i = 0; i < own.count(); ++i)
      *kept += std::count_if(leaf[i].row, leaf[i].row + kLeafSize, [](uint32_t row) { return row != kNoId; });
  });
}

PC_EXPORT int32_t pc_indexed_neighbors(const pc_context* context, const float* leaves, const int64_t* leaf_ptr,
                                       int64_t num_clouds, const float* boxes, int64_t num_points, const float* queries,
                                       const int64_t* queries_ptr, int64_t k, double limit, const float* limits,
                                       int64_t* index, float* distance) {
  using namespace pc;
  using namespace pc::neighbors;
  return guarded([&] {
    // Searching reads leaves and boxes alone.
    const Leaves own{reinterpret_cast<Leaf*>(const_cast<float*>(leaves)), leaf_ptr, num_clouds};
    const Clouds from{queries, queries_ptr, num_clouds};
    const WriteNeighbors task{k, num_points, index, distance};
    const auto find = k <= NearestKeys::kMax ? find_in_index<NearestKeys> : find_in_index<NearestMany>;
    find(*context, {static_cast<float>(limit), limits}, own, reinterpret_cast<Boxes*>(const_cast<float*>(boxes)),
         queries == nullptr ? nullptr : &from, task);
  });
}

PC_EXPORT int32_t pc_nearest_squared(const pc_context* context, const float* points, const int64_t* ptr,
                                     int64_t num_clouds, const float* queries, const int64_t* queries_ptr,
                                     float* squared) {
  using namespace pc;
  using namespace pc::neighbors;
  return guarded([&] {
    const WriteNearest task{squared};
    BatchSearch<NearestDistances, WriteNearest>(*context, 1, kInfinity, task)
        .run({points, ptr, num_clouds}, {queries, queries_ptr, num_clouds});
  });
}
