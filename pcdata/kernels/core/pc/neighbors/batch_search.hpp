// Every query of a batch searched: by windows where there is a depth image and a proof, else by the box tree.
#pragma once

#include "pc/neighbors/nearest_distances.hpp"
#include "pc/neighbors/window_search.hpp"

namespace pc::neighbors {

// A query without a proof, and the k-th squared distance that it has found: the tree need not look farther.
struct Unproved {
  uint32_t row;
  float limit;
};

struct Clouds {
  const float* points;  // (N, 3)
  const int64_t* ptr;   // (B+1,)
  int64_t num_clouds;
};

// A task is copied for every piece of work and called as
//   task(search, group, nearest, row)
// once per group of queries: `nearest` has found everything for the active lanes, whose query rows are `row`; the
// search can replay() its candidates, and `search.row(id)` turns the id of a neighbor into its row.
template <class Nearest, class Task>
class BatchSearch {
 public:
  BatchSearch(const pc_context& context, int64_t k, const Limits& limits, const Task& task)
      : context_(context), k_(static_cast<int>(k)), limits_(limits), task_(task) {}

  // Queries are the points themselves.
  void run(const Clouds& clouds, const Grid* grid) {
    if (grid == nullptr || k_ > NearestDistances::kMax) {
      ScratchFrame scratch;
      return by_tree(scratch, clouds);
    }
    for (int64_t b = 0; b < clouds.num_clouds; ++b) {
      ScratchFrame scratch;  // each cloud gets its image in turn: memory is for the largest, not for all
      by_windows(scratch, clouds, *grid, b);
    }
  }

  // Queries of their own.
  void run(const Clouds& clouds, const Clouds& queries) {
    ScratchFrame scratch;
    LeafBuilder points(context_, scratch, clouds.points, clouds.ptr, clouds.num_clouds);
    const int64_t* unused;
    run(scratch, build_trees(context_, scratch, points.without_copies(k_, unused)), queries);
  }

  // Queries of their own, in trees that are built.
  void run(ScratchFrame& scratch, const CloudTree* trees, const Clouds& queries) {
    LeafBuilder groups(context_, scratch, queries.points, queries.ptr, queries.num_clouds);
    for_groups(groups.all(), [&](const Leaf& leaf, int64_t, int64_t cloud, TreeSearch& search, Worker& worker) {
      const QueryGroup group(leaf);
      worker.nearest.start(k_, group.limits(limits_, leaf.row));
      if (trees[cloud].num_leaves > 0)
        search.run(trees[cloud], group, search.leaf_near(trees[cloud], group), worker.nearest);
      worker.nearest.finish();
      worker.task(search, group, worker.nearest, leaf.row);
    });
  }

  // Queries are the points themselves: group g of them begins in leaf home[g]; null = it is leaf g.
  void by_tree(const Leaves& leaves, const CloudTree* trees, const Leaves& groups, const int64_t* home) {
    for_groups(groups, [&](const Leaf& leaf, int64_t g, int64_t cloud, TreeSearch& search, Worker& worker) {
      const QueryGroup group(leaf);
      worker.nearest.start(k_, group.limits(limits_, leaf.row));
      search.run(trees[cloud], group, (home == nullptr ? g : home[g]) - leaves.leaf_ptr[cloud], worker.nearest);
      worker.nearest.finish();
      worker.task(search, group, worker.nearest, leaf.row);
    });
  }

  // Search for queries of an organized cloud, rows `begin` to `end`, that windows have left without a proof.
  void finish(ScratchFrame& scratch, const float* points, const OrganizedCloud& cloud, int64_t begin, int64_t end,
              const Unproved* unproved, int64_t count) {
    if (count == 0) return;
    if (count * kOneIn > end - begin) {
      // The grid does not fit the points: near in the image need not be near in space.
      const int64_t alone[2] = {begin, end};
      LeafBuilder builder(context_, scratch, points, alone, 1);
      const int64_t* unused;
      return finish_by_tree(scratch, points, builder.without_copies(k_, unused), unproved, count);
    }
    finish_by_tree(scratch, points, cloud.tile_leaves(context_, scratch), unproved, count);
  }

 private:
  struct Worker {
    Nearest nearest;
    Task task;
  };

  // Queries per piece of parallel work: a thousand for small k, fewer where each takes long.
  int64_t groups_per_piece() const { return std::max<int64_t>(1, 64 * 16 / std::max(k_, 16)); }

  template <class Body>
  void for_groups(const Leaves& groups, Body&& body) {
    parallel_for(context_, groups.count(), groups_per_piece(), [&](int64_t begin, int64_t end, int64_t) {
      TreeSearch search;
      Worker worker{{}, task_};
      int64_t cloud =
          std::upper_bound(groups.leaf_ptr, groups.leaf_ptr + groups.num_clouds + 1, begin) - groups.leaf_ptr - 1;
      for (int64_t g = begin; g < end; ++g) {
        while (g >= groups.leaf_ptr[cloud + 1]) ++cloud;
        body(groups.leaf[g], g, cloud, search, worker);
      }
    });
  }

  void by_tree(ScratchFrame& scratch, const Clouds& clouds) {
    LeafBuilder builder(context_, scratch, clouds.points, clouds.ptr, clouds.num_clouds);
    const int64_t* home;
    const Leaves leaves = builder.without_copies(k_, home);
    by_tree(leaves, build_trees(context_, scratch, leaves), builder.all(), home);
  }

  // A window starts with about twice as many pixels as neighbors are wanted and grows by a few rings, each of which
  // costs every lane: what is then not proved (1-2 % on a tabletop frame) is cheaper in the tree.
  static constexpr int kMoreRings = 4;
  static constexpr int64_t kOneIn = 16;  // more queries without a proof than this mean a grid that does not fit
  int first_reach() const {
    int reach = 1;
    while ((2 * reach + 1) * (2 * reach + 1) < 2 * k_) ++reach;
    return reach;
  }

  void by_windows(ScratchFrame& scratch, const Clouds& clouds, const Grid& grid, int64_t b) {
    const int64_t begin = clouds.ptr[b], end = clouds.ptr[b + 1];
    if (begin == end) return;
    const int64_t alone[2] = {begin, end};
    const WindowRings rings(first_reach() + kMoreRings);
    OrganizedCloud cloud;
    if (!cloud.build(context_, scratch, clouds.points, grid, b, begin, end, first_reach() + kMoreRings))
      return by_tree(scratch, {clouds.points, alone, 1});
    Unproved* unproved = scratch.take<Unproved>(end - begin);
    std::atomic<int64_t> num_unproved{0};
    parallel_for(context_, cloud.height(), 1, [&](int64_t v, int64_t, int64_t) {
      WindowSearch search(cloud, rings);
      Worker worker{{}, task_};
      for (int64_t u = 0; u < cloud.width(); u += kQueries) {
        QueryGroup group = search.queries_at(u, v);
        const PackMask points = group.active;
        if (points == 0) continue;
        uint32_t row[kQueries] = {};
        for (PackMask left = points; left != 0; left &= left - 1) {
          const int lane = __builtin_ctz(left);
          row[lane] = cloud.row(v * cloud.stride() + u + lane);
        }
        worker.nearest.start(k_, group.limits(limits_, row));
        group.active = search.run(group, u, v, first_reach(), worker.nearest);
        if (const PackMask rest = points & ~group.active) {
          alignas(64) float bound[kQueries];
          worker.nearest.bound().store(bound);
          Unproved* next = unproved + num_unproved.fetch_add(__builtin_popcount(rest), std::memory_order_relaxed);
          for (PackMask left = rest; left != 0; left &= left - 1) {
            const int lane = __builtin_ctz(left);
            *next++ = {row[lane], bound[lane]};
          }
        }
        if (group.active == 0) continue;
        worker.nearest.finish();
        worker.task(search, group, worker.nearest, row);
      }
    });
    finish(scratch, clouds.points, cloud, begin, end, unproved, num_unproved.load());
  }

  void finish_by_tree(ScratchFrame& scratch, const float* rows, const Leaves& leaves, const Unproved* queries,
                      int64_t count) {
    const CloudTree* tree = build_trees(context_, scratch, leaves);
    // Stragglers are sorted in space too, so that the sixteen of a group look into the same boxes.
    float* points = scratch.take<float>(3 * count);
    for (int64_t i = 0; i < count; ++i) std::copy_n(rows + 3 * int64_t{queries[i].row}, 3, points + 3 * i);
    const int64_t all[2] = {0, count};
    LeafBuilder groups(context_, scratch, points, all, 1);
    for_groups(groups.all(), [&](const Leaf& leaf, int64_t, int64_t, TreeSearch& search, Worker& worker) {
      const QueryGroup group(leaf);
      alignas(64) float limit[kQueries];
      uint32_t row[kQueries] = {};
      std::fill_n(limit, kQueries, kOff);
      for (PackMask left = group.active; left != 0; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        row[lane] = queries[leaf.row[lane]].row;
        limit[lane] = queries[leaf.row[lane]].limit;
      }
      worker.nearest.start(k_, FloatPack::load(limit));
      search.run(*tree, group, search.leaf_near(*tree, group), worker.nearest);
      worker.nearest.finish();
      worker.task(search, group, worker.nearest, row);
    });
  }

  const pc_context& context_;
  int k_;
  Limits limits_;
  const Task& task_;
};

}  // namespace pc::neighbors
