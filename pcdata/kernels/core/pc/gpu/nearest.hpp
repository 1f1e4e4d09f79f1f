// The nearest neighbors of queries, by warps: 32 queries that follow each other in the order of the points walk down
// the tree of boxes together, nearest boxes first, and enter a box if one of them may find a neighbor in it.
//
// A neighbor is a key: the bits of its squared distance, which ascend as the distance does, above its row. So keys
// ascend by (distance, row), and a box is left out exactly where (distance to it, its lowest row) is no lower than the
// last key.
#pragma once

#include "pc/gpu/box_tree.hpp"

namespace pc::gpu {

PC_HD uint64_t key_of(float squared, int32_t row) {
  return static_cast<uint64_t>(bits_of(squared)) << 32 | static_cast<uint32_t>(row);
}
PC_HD float squared_of(uint64_t key) { return float_of(static_cast<uint32_t>(key >> 32)); }
PC_HD int32_t row_of(uint64_t key) { return static_cast<int32_t>(key & 0xFFFFFFFFu); }

// No neighbor: beyond every distance.
constexpr uint64_t kNoKey = ~uint64_t{0};

// The least `wanted` keys of those offered, ascending.
template <int kMost>
struct FewKeys {
  uint64_t kept[kMost];
  int wanted;

  PC_HD void start(int64_t k) {
    wanted = static_cast<int>(k);
    for (int i = 0; i < wanted; ++i) kept[i] = kNoKey;
  }
  PC_HD uint64_t last() const { return kept[wanted - 1]; }
  PC_HD void offer(uint64_t key) {
    int i = wanted - 1;
    for (; i > 0 && kept[i - 1] > key; --i) kept[i] = kept[i - 1];
    kept[i] = key;
  }
  PC_HD void finish() {}
  PC_HD uint64_t at(int64_t i) const { return kept[i]; }
};

// Any number of them, in memory of the device: a heap with the largest on top, sorted at the end.
struct ManyKeys {
  uint64_t* kept;
  int64_t wanted;

  PC_HD void start(int64_t k) {
    wanted = k;
    for (int64_t i = 0; i < wanted; ++i) kept[i] = kNoKey;
  }
  PC_HD uint64_t last() const { return kept[0]; }
  PC_HD void offer(uint64_t key) { sift(key, wanted); }
  PC_HD void finish() {
    for (int64_t left = wanted - 1; left > 0; --left) {
      const uint64_t largest = kept[0];
      sift(kept[left], left);
      kept[left] = largest;
    }
  }
  PC_HD uint64_t at(int64_t i) const { return kept[i]; }

 private:
  // Put a key in the place of the largest of a heap.
  PC_HD void sift(uint64_t key, int64_t size) {
    int64_t place = 0;
    for (;;) {
      int64_t child = 2 * place + 1;
      if (child >= size) break;
      if (child + 1 < size && kept[child + 1] > kept[child]) ++child;
      if (kept[child] <= key) break;
      kept[place] = kept[child];
      place = child;
    }
    kept[place] = key;
  }
};

struct Tree {
  const Placed* placed;
  int64_t points;
  Boxes boxes;

  static constexpr int kMostLevels = 6;  // 32^6 leaves are more than 2^31 rows can fill
};

// What one lane looks for.
struct Query {
  float x, y, z;
  int64_t begin, end;  // places of its cloud; none for a lane without a query
  uint64_t most;       // no key above it counts
};

// Find the neighbors of the queries of a warp. Every lane calls.
template <class Keys>
PC_HD void search(const Tree& tree, const Query& query, Keys& keys) {
  const float point[3] = {query.x, query.y, query.z};
  const math::Bounds own = math::Bounds::of_point(point);
  // The box of the warp's queries, and the places that they search; lanes without a query do not count.
  const bool has_query = query.begin < query.end;
  const float infinity = float_of(0x7F800000u);
  math::Bounds group;
  for (int axis = 0; axis < 3; ++axis) {
    group.low[axis] = warp_min(has_query ? point[axis] : infinity);
    group.high[axis] = warp_max(has_query ? point[axis] : -infinity);
  }
  const int64_t begin = warp_min(has_query ? query.begin : tree.points), end = warp_max(has_query ? query.end : 0);
  if (begin >= end) return;

  int64_t level_first[Tree::kMostLevels], level_nodes[Tree::kMostLevels];  // nodes of each level in the arrays of boxes
  int top = 0;
  level_first[0] = 0;
  level_nodes[0] = (tree.points + kFan - 1) >> kFanBits;
  while (level_nodes[top] > kFan) {
    level_first[top + 1] = level_first[top] + level_nodes[top];
    level_nodes[top + 1] = (level_nodes[top] + kFan - 1) >> kFanBits;
    ++top;
  }

  const auto worst = [&] {
    const uint64_t last = keys.last();
    return !has_query ? 0 : last < query.most ? last : query.most;
  };

  int64_t children[Tree::kMostLevels];  // the first of those under way, counted within their level
  uint32_t waiting[Tree::kMostLevels];  // which of them are still to be entered
  float gaps[Tree::kMostLevels];        // from the group to this lane's child
  int level = top;
  bool is_new = true;
  children[top] = 0;
  for (;;) {
    const int shift = kFanBits * (level + 1);
    if (is_new) {
      const int64_t child = children[level] + lane();
      bool wanted = child < level_nodes[level] && child << shift < end && (child + 1) << shift > begin;
      const uint64_t farthest = warp_max(worst());
      if (wanted) {
        const int64_t node = level_first[level] + child;
        gaps[level] = math::squared_gap(group, tree.boxes.box(node));
        wanted = key_of(gaps[level], tree.boxes.rows[node]) <= farthest;
      }
      waiting[level] = ballot(wanted);
      is_new = false;
    }
    if (waiting[level] == 0) {
      if (level == top) return;
      ++level;
      continue;
    }
    const bool waits = waiting[level] >> lane() & 1;
    const uint32_t gap = waits ? bits_of(gaps[level]) : 0xFFFFFFFFu;
    const int nearest = lowest_bit(ballot(gap == warp_min(gap)));
    waiting[level] &= ~(1u << nearest);
    const int64_t child = children[level] + nearest, node = level_first[level] + child;
    const bool wants = child << shift < query.end && (child + 1) << shift > query.begin &&
                       key_of(math::squared_gap(own, tree.boxes.box(node)), tree.boxes.rows[node]) <= worst();
    if (ballot(wants) == 0) continue;
    if (level > 0) {
      --level;
      children[level] = child << kFanBits;
      is_new = true;
      continue;
    }
    const int64_t first = child << kFanBits, past = first + kFan < tree.points ? first + kFan : tree.points;
    uint64_t most = worst();
    for (int64_t i = first; i < past; ++i) {
      const Placed p = tree.placed[i];
      const uint64_t key = key_of(math::squared_distance(p.x, p.y, p.z, query.x, query.y, query.z), p.row);
      if (i < query.begin || i >= query.end || key > most) continue;
      keys.offer(key);
      most = worst();
    }
  }
}

// Queries in their order, and what is to be told of each.
struct Task {
  const float* queries;        // (Q, 3)
  const int64_t* query_ptr;    // (clouds + 1)
  const int64_t* query_order;  // (Q): the rows of queries in the order of the points
  const int64_t* ptr;          // (clouds + 1), of the points
  int64_t clouds, count, k;
  double limit;         // of squared distances, inclusive
  const float* limits;  // (Q), or null: the same for each query
  int64_t missing;      // what stands for the row of no neighbor
  int64_t* index;       // (Q, k), or null
  float* told;          // (Q, k) distances, or their squares
  int64_t squared;      // whether it is their squares
  double* mean;         // (Q): the mean distance, or null

  PC_HD int64_t place() const { return thread_index(); }
  PC_HD Query query() const {
    if (place() >= count) return {0, 0, 0, 0, 0, 0};
    const int64_t row = query_order[place()], cloud = cloud_of(query_ptr, clouds, row);
    const float* p = queries + 3 * row;
    const float most = limits == nullptr ? static_cast<float>(limit) : limits[row];
    return {p[0], p[1], p[2], ptr[cloud], ptr[cloud + 1], key_of(most, -1)};
  }
  template <class Keys>
  PC_HD void tell(Keys& keys) const {
    if (place() >= count) return;
    const int64_t row = query_order[place()];
    keys.finish();
    double sum = 0, found = 0;
    for (int64_t i = 0; i < k; ++i) {
      const uint64_t key = keys.at(i);
      const bool is_found = key != kNoKey;
      const float distance2 = is_found ? squared_of(key) : float_of(0x7F800000u);
      if (mean != nullptr) {
        if (is_found) {
          sum += sqrt(static_cast<double>(distance2));
          found += 1;
        }
        continue;
      }
      index[row * k + i] = is_found ? row_of(key) : missing;
      told[row * k + i] = squared ? distance2 : static_cast<float>(sqrt(static_cast<double>(distance2)));
    }
    if (mean != nullptr) mean[row] = sum / found;
  }
};

#define PC_SEARCH_PARAMETERS                                                                                          \
  const float *queries, const int64_t *query_ptr, const int64_t *query_order, const int64_t *ptr, int64_t clouds,     \
      int64_t count, int64_t k, double limit, const float *limits, const float *placed, int64_t points, float *sides, \
      int32_t *least_rows, int64_t nodes, int64_t missing, int64_t *index, float *told, int64_t squared, double *mean
#define PC_SEARCH_TASK                                                            \
  const Task task{queries, query_ptr, query_order, ptr,   clouds, count,   k,     \
                  limit,   limits,    missing,     index, told,   squared, mean}; \
  const Tree tree {                                                               \
    reinterpret_cast<const Placed*>(placed), points, { sides, least_rows, nodes } \
  }

template <int kMost>
PC_HD void find_few(const Tree& tree, const Task& task) {
  FewKeys<kMost> keys;
  keys.start(task.k);
  search(tree, task.query(), keys);
  task.tell(keys);
}

// For up to so many neighbors.
PC_BLOCK_KERNEL(pc_nearest_8, PC_SEARCH_PARAMETERS) {
  PC_SEARCH_TASK;
  find_few<8>(tree, task);
}
PC_BLOCK_KERNEL(pc_nearest_16, PC_SEARCH_PARAMETERS) {
  PC_SEARCH_TASK;
  find_few<16>(tree, task);
}
PC_BLOCK_KERNEL(pc_nearest_32, PC_SEARCH_PARAMETERS) {
  PC_SEARCH_TASK;
  find_few<32>(tree, task);
}
PC_BLOCK_KERNEL(pc_nearest_64, PC_SEARCH_PARAMETERS) {
  PC_SEARCH_TASK;
  find_few<64>(tree, task);
}

// For any number: `index` holds the keys until they are told.
PC_BLOCK_KERNEL(pc_nearest_many, PC_SEARCH_PARAMETERS) {
  PC_SEARCH_TASK;
  const bool is_one = task.place() < count;
  // A lane without a query has room for one key, which nothing reads.
  uint64_t nothing = kNoKey;
  ManyKeys keys{is_one ? reinterpret_cast<uint64_t*>(index) + query_order[task.place()] * k : &nothing, is_one ? k : 1};
  keys.start(keys.wanted);
  search(tree, task.query(), keys);
  task.tell(keys);
}

}  // namespace pc::gpu
