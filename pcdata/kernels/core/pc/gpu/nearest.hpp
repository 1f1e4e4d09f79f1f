// The nearest neighbors of queries, by warps: 32 queries that follow each other in the order of the points walk down
// the tree of boxes together, nearest boxes first, and enter a box if one of them may find a neighbor in it.
//
// A neighbor is a key: the bits of its squared distance, which ascend as the distance does, above its row. So keys
// ascend by (distance, row), and a box is left out exactly where (distance to it, its lowest row) is no lower than the
// last key.
#pragma once

#include "pc/gpu/box_tree.hpp"
#include "pc/math/normal.hpp"

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

// Queries in their order, and what they look for.
struct Queries {
  const float* points;   // (Q, 3)
  const int64_t* ptr;    // (clouds + 1)
  const int64_t* order;  // (Q): rows in the order of the points
  int64_t count, clouds;
  const int64_t* points_ptr;  // (clouds + 1), of the points that are searched
  int64_t k;
  double limit;         // of squared distances, inclusive
  const float* limits;  // (Q), or null: the same for each query
  const int32_t* some;  // (1,), so many of them, or null: all

  PC_HD bool is_one() const { return thread_index() < (some == nullptr ? filled(ptr, clouds, count) : *some); }
  PC_HD int64_t row() const { return order[thread_index()]; }
  PC_HD Query query() const {
    if (!is_one()) return {0, 0, 0, 0, 0, 0};
    const int64_t cloud = cloud_of(ptr, clouds, row());
    const float* p = points + 3 * row();
    const float most = limits == nullptr ? static_cast<float>(limit) : limits[row()];
    return {p[0], p[1], p[2], points_ptr[cloud], points_ptr[cloud + 1], key_of(most, -1)};
  }
};

PC_HD float rooted(float squared) { return static_cast<float>(sqrt(static_cast<double>(squared))); }

// Writes rows and distances, or the squares of these; beyond the last neighbor `missing` and infinity.
struct Neighbors {
  int64_t k, missing;
  int64_t* index;  // (Q, k)
  float* told;     // (Q, k)
  bool squares;

  template <class Keys>
  PC_HD void operator()(const Keys& keys, int64_t row, const Query&) const {
    for (int64_t i = 0; i < k; ++i) {
      const uint64_t key = keys.at(i);  // which may lie where the index goes
      const bool is_found = key != kNoKey;
      const float squared = is_found ? squared_of(key) : float_of(0x7F800000u);
      index[row * k + i] = is_found ? row_of(key) : missing;
      told[row * k + i] = squares ? squared : rooted(squared);
    }
  }
};

// Writes the mean distance.
struct MeanDistance {
  int64_t k;
  double* mean;  // (Q)

  template <class Keys>
  PC_HD void operator()(const Keys& keys, int64_t row, const Query&) const {
    double sum = 0;
    int64_t found = 0;
    for (; found < k && keys.at(found) != kNoKey; ++found)
      sum += static_cast<double>(rooted(squared_of(keys.at(found))));
    mean[row] = sum / static_cast<double>(found);
  }
};

// Writes the direction in which the neighbors vary least.
struct Normal {
  int64_t k;
  const float* points;  // (N, 3), that are searched
  float* normals;       // (Q, 3)

  template <class Keys>
  PC_HD void operator()(const Keys& keys, int64_t row, const Query& query) const {
    math::Moments m{0, 0, 0, 0, {0, 0, 0, 0, 0, 0}};
    for (int64_t i = 0; i < k && keys.at(i) != kNoKey; ++i) {
      const float* p = points + 3 * static_cast<int64_t>(row_of(keys.at(i)));
      const double x = static_cast<double>(p[0]) - static_cast<double>(query.x),
                   y = static_cast<double>(p[1]) - static_cast<double>(query.y),
                   z = static_cast<double>(p[2]) - static_cast<double>(query.z);
      m.count += 1;
      m.x += x;
      m.y += y;
      m.z += z;
      m.square.xx += x * x;
      m.square.xy += x * y;
      m.square.xz += x * z;
      m.square.yy += y * y;
      m.square.yz += y * z;
      m.square.zz += z * z;
    }
    const math::Vector3 normal = math::normal_of(m);
    normals[3 * row] = static_cast<float>(normal.x);
    normals[3 * row + 1] = static_cast<float>(normal.y);
    normals[3 * row + 2] = static_cast<float>(normal.z);
  }
};

template <class Keys, class Tell>
PC_HD void find(const Tree& tree, const Queries& queries, Keys& keys, const Tell& tell) {
  const Query query = queries.query();
  search(tree, query, keys);
  if (!queries.is_one()) return;
  keys.finish();
  tell(keys, queries.row(), query);
}

template <int kMost, class Tell>
PC_HD void find_few(const Tree& tree, const Queries& queries, const Tell& tell) {
  FewKeys<kMost> keys;
  keys.start(queries.k);
  find(tree, queries, keys, tell);
}

#define PC_SEARCH_PARAMETERS                                                                                      \
  const float *queries, const int64_t *query_ptr, const int64_t *query_order, const int64_t *ptr, int64_t clouds, \
      int64_t count, int64_t k, double limit, const float *limits, const int32_t *some, const float *placed,      \
      int64_t points, float *sides, int32_t *least_rows, int64_t nodes
#define PC_SEARCH                                                                                   \
  const Queries asked{queries, query_ptr, query_order, count, clouds, ptr, k, limit, limits, some}; \
  const Tree tree {                                                                                 \
    reinterpret_cast<const Placed*>(placed), points, { sides, least_rows, nodes }                   \
  }

// Neighbors, for up to so many of them.
#define PC_NEAREST_PARAMETERS PC_SEARCH_PARAMETERS, int64_t missing, int64_t *index, float *told, int64_t squares
PC_BLOCK_KERNEL(pc_nearest_8, PC_NEAREST_PARAMETERS) {
  PC_SEARCH;
  find_few<8>(tree, asked, Neighbors{k, missing, index, told, squares != 0});
}
PC_BLOCK_KERNEL(pc_nearest_16, PC_NEAREST_PARAMETERS) {
  PC_SEARCH;
  find_few<16>(tree, asked, Neighbors{k, missing, index, told, squares != 0});
}
PC_BLOCK_KERNEL(pc_nearest_32, PC_NEAREST_PARAMETERS) {
  PC_SEARCH;
  find_few<32>(tree, asked, Neighbors{k, missing, index, told, squares != 0});
}
PC_BLOCK_KERNEL(pc_nearest_64, PC_NEAREST_PARAMETERS) {
  PC_SEARCH;
  find_few<64>(tree, asked, Neighbors{k, missing, index, told, squares != 0});
}

// For any number: `index` holds the keys until they are told.
PC_BLOCK_KERNEL(pc_nearest_many, PC_NEAREST_PARAMETERS) {
  PC_SEARCH;
  uint64_t nothing = kNoKey;  // the room of a lane without a query
  ManyKeys keys{asked.is_one() ? reinterpret_cast<uint64_t*>(index) + asked.row() * k : &nothing,
                asked.is_one() ? k : 1};
  keys.start(keys.wanted);
  find(tree, asked, keys, Neighbors{k, missing, index, told, squares != 0});
}

PC_BLOCK_KERNEL(pc_mean_distances_32, PC_SEARCH_PARAMETERS, double* mean) {
  PC_SEARCH;
  find_few<32>(tree, asked, MeanDistance{k, mean});
}
PC_BLOCK_KERNEL(pc_mean_distances_64, PC_SEARCH_PARAMETERS, double* mean) {
  PC_SEARCH;
  find_few<64>(tree, asked, MeanDistance{k, mean});
}

PC_BLOCK_KERNEL(pc_normals_32, PC_SEARCH_PARAMETERS, float* normals) {
  PC_SEARCH;
  find_few<32>(tree, asked, Normal{k, queries, normals});
}
PC_BLOCK_KERNEL(pc_normals_64, PC_SEARCH_PARAMETERS, float* normals) {
  PC_SEARCH;
  find_few<64>(tree, asked, Normal{k, queries, normals});
}

}  // namespace pc::gpu
