// All neighbors within a radius, counted, then listed: their number is known before memory is made for them.
#include "pc/neighbors/nearest_keys.hpp"
#include "pc/neighbors/within_search.hpp"

namespace pc::neighbors {
namespace {

// Points and queries as leaves, and the radii of the queries.
struct WithinCall {
  const pc_context& context;
  Leaves points;
  Boxes* boxes;
  Leaves groups;
  const float* radii;  // (1,) or (Q,)
  bool per_query, exclude_self;

  // Searching reads leaves and boxes alone.
  WithinCall(const pc_context& own_context, int64_t num_clouds, const float* leaves, const int64_t* leaf_ptr,
             const float* own_boxes, const float* queries, const int64_t* query_ptr, const float* own_radii,
             int64_t has_own_radii, int64_t is_excluded)
      : context(own_context),
        points(leaves_at(leaves, leaf_ptr, num_clouds)),
        boxes(reinterpret_cast<Boxes*>(const_cast<float*>(own_boxes))),
        groups(leaves_at(queries, query_ptr, num_clouds)),
        radii(own_radii),
        per_query(has_own_radii != 0),
        exclude_self(is_excluded != 0) {}

  float limit(uint32_t row) const {
    const float radius = radii[per_query ? row : 0];
    return radius * radius;
  }

  // body(tree, group, rows of its lanes, limits of its lanes, worker) for every group of queries.
  template <class Worker, class Body>
  void run(Body&& body) const {
    constexpr int64_t kGroups = 8;  // few: a query may have all points for neighbors
    ScratchFrame scratch;
    const CloudTree* trees = lay_out_trees(scratch, points, boxes);
    parallel_for(context, groups.count(), kGroups, [&](int64_t begin, int64_t end, int64_t) {
      Worker worker;
      const int64_t* first = groups.leaf_ptr;
      int64_t cloud = std::upper_bound(first, first + groups.num_clouds + 1, begin) - first - 1;
      for (int64_t g = begin; g < end; ++g) {
        while (g >= first[cloud + 1]) ++cloud;
        const Leaf& leaf = groups.leaf[g];
        const QueryGroup group(leaf);
        alignas(64) float limits[kQueries];
        for (int lane = 0; lane < kQueries; ++lane)
          limits[lane] = group.active >> lane & 1 ? limit(leaf.row[lane]) : kOff;
        body(trees[cloud], group, leaf, limits, worker);
      }
    });
  }

  // body(lane, leaf, distances, mask of the neighbors) for every leaf with neighbors of a lane.
  template <class Body>
  void for_neighbors(const CloudTree& tree, const QueryGroup& group, const Leaf& query, const float* limits,
                     Body&& body) const {
    if (tree.num_leaves == 0) return;
    for_leaves_within(tree, group, FloatPack::load(limits), tree.num_levels - 1, 0,
                      [&](const Leaf& leaf, PackMask lanes) {
                        for (; lanes != 0; lanes &= lanes - 1) {
                          const int lane = __builtin_ctz(lanes);
                          const LeafDistances at(leaf, query.x[lane], query.y[lane], query.z[lane], limits[lane]);
                          PackMask near = at.near;
                          if (exclude_self && near != 0) near &= ~lane_of_row(leaf, query.row[lane]);
                          if (near != 0) body(lane, leaf, at, near);
                        }
                      });
  }

 private:
  static Leaves leaves_at(const float* numbers, const int64_t* leaf_ptr, int64_t num_clouds) {
    return {reinterpret_cast<Leaf*>(const_cast<float*>(numbers)), leaf_ptr, num_clouds};
  }
};

struct Counter {
  int64_t count[kQueries];
};

// What a thread keeps for the neighbors of sixteen queries.
struct Lister {
  std::vector<uint64_t> keys;
  DistanceSorter sorter;
};

void count_within(const WithinCall& call, int64_t* counts) {
  call.run<Counter>(
      [&](const CloudTree& tree, const QueryGroup& group, const Leaf& query, const float* limits, Counter& counter) {
        std::fill_n(counter.count, kQueries, int64_t{0});
        call.for_neighbors(tree, group, query, limits, [&](int lane, const Leaf&, const LeafDistances&, PackMask near) {
          counter.count[lane] += __builtin_popcount(near);
        });
        for (PackMask left = group.active; left != 0; left &= left - 1) {
          const int lane = __builtin_ctz(left);
          counts[query.row[lane]] = counter.count[lane];
        }
      });
}

void list_within(const WithinCall& call, const int64_t* neighbors_ptr, int64_t* index, float* distance) {
  call.run<Lister>(
      [&](const CloudTree& tree, const QueryGroup& group, const Leaf& query, const float* limits, Lister& lister) {
        int64_t begin[kQueries + 1], end[kQueries];
        begin[0] = 0;
        for (int lane = 0; lane < kQueries; ++lane) {
          const bool real = group.active >> lane & 1;
          const int64_t* ptr = neighbors_ptr + (real ? query.row[lane] : 0);
          end[lane] = begin[lane];
          begin[lane + 1] = begin[lane] + (real ? ptr[1] - ptr[0] : 0);
        }
        lister.keys.resize(static_cast<size_t>(begin[kQueries]));
        uint64_t* keys = lister.keys.data();
        call.for_neighbors(tree, group, query, limits,
                           [&](int lane, const Leaf& leaf, const LeafDistances& at, PackMask near) {
                             alignas(64) float squared[kQueries];
                             at.squared.store(squared);
                             uint64_t* next = keys + end[lane];
                             end[lane] += __builtin_popcount(near);
                             for (; near != 0; near &= near - 1) {
                               const int i = __builtin_ctz(near);
                               *next++ = NearKey::of(squared[i], leaf.row[i]);
                             }
                           });
        for (PackMask left = group.active; left != 0; left &= left - 1) {
          const int lane = __builtin_ctz(left);
          const int64_t count = end[lane] - begin[lane], to = neighbors_ptr[query.row[lane]];
          const uint64_t* sorted = lister.sorter.sort(keys + begin[lane], count, limits[lane]);
          for (int64_t i = 0; i < count; ++i) index[to + i] = NearKey::id(sorted[i]);
          for (int64_t i = 0; i < count; ++i) distance[to + i] = std::sqrt(NearKey::squared(sorted[i]));
        }
      });
}

}  // namespace
}  // namespace pc::neighbors

PC_EXPORT int32_t pc_count_within(const pc_context* context, const float* leaves, const int64_t* leaf_ptr,
                                  int64_t num_clouds, const float* boxes, const float* groups, const int64_t* group_ptr,
                                  const float* radii, int64_t per_query, int64_t exclude_self, int64_t* counts) {
  using namespace pc;
  using namespace pc::neighbors;
  return guarded([&] {
    count_within({*context, num_clouds, leaves, leaf_ptr, boxes, groups, group_ptr, radii, per_query, exclude_self},
                 counts);
  });
}

PC_EXPORT int32_t pc_list_within(const pc_context* context, const float* leaves, const int64_t* leaf_ptr,
                                 int64_t num_clouds, const float* boxes, const float* groups, const int64_t* group_ptr,
                                 const float* radii, int64_t per_query, int64_t exclude_self,
                                 const int64_t* neighbors_ptr, int64_t* index, float* distance) {
  using namespace pc;
  using namespace pc::neighbors;
  return guarded([&] {
    list_within({*context, num_clouds, leaves, leaf_ptr, boxes, groups, group_ptr, radii, per_query, exclude_self},
                neighbors_ptr, index, distance);
  });
}
