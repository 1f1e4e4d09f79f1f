// DBSCAN in linear memory: core points of one cell are one cluster, so only cells need joining.
//
// Source: Wang, Gu and Shun, Theoretically-efficient and practical parallel DBSCAN, SIGMOD 2020; the numbering of
// clusters and the border points follow Open3D.
#include "pc/bounds.hpp"
#include "pc/cells/pair_search.hpp"
#include "pc/cells/union_find.hpp"

namespace pc::cells {
namespace {

template <class Key>
class Clustering {
 public:
  Clustering(const pc_context& context, ScratchFrame& scratch, const Cells<Key>& cells, float limit, int64_t min_points)
      : context_(context),
        cells_(cells),
        limit_(limit),
        min_points_(min_points),
        core_(scratch.take<uint8_t>(cells.num_points)),
        num_core_(scratch.take<uint32_t>(cells.count)),
        sets_(scratch.take<std::atomic<uint32_t>>(cells.count), cells.count),
        label_(scratch.take<uint32_t>(cells.count)) {}

  void run(int64_t* labels) {  // (n,) out
    find_core_points();
    put_core_points_first();
    join_cells();
    number_clusters(labels);
    write_labels(labels);
  }

 private:
  static constexpr int64_t kGrain = 1024;  // points or cells: short enough for Ctrl-C even where each meets thousands
  static constexpr uint32_t kNone = std::numeric_limits<uint32_t>::max();

  Range core_points(int64_t cell) const { return {cells_.start[cell], cells_.start[cell] + num_core_[cell]}; }

  void find_core_points() {
    parallel_for(context_, cells_.num_points, kGrain, [&](int64_t begin, int64_t end, int64_t) {
      Neighborhood<Key> around(cells_, kAllRows);
      for_each_cell(cells_, begin, end, [&](int64_t cell, int64_t first, int64_t last) {
        const bool crowded = cells_.size(cell) >= min_points_;
        if (!crowded) around.move_to(cell);
        for (int64_t i = first; i < last; ++i)
          core_[i] = crowded || has_near(cells_, around, cell, i, limit_, min_points_);
      });
    });
  }

  void put_core_points_first() {
    parallel_for(context_, cells_.count, kGrain, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t cell = begin; cell < end; ++cell) {
        const int64_t first = cells_.start[cell], last = cells_.start[cell + 1];
        int64_t next = cells_.size(cell) >= min_points_ ? last : first;  // a crowded cell is all core
        for (int64_t i = next; i < last; ++i) {
          if (!core_[i]) continue;
          std::swap(cells_.x[i], cells_.x[next]);
          std::swap(cells_.y[i], cells_.y[next]);
          std::swap(cells_.z[i], cells_.z[next]);
          std::swap(cells_.row[i], cells_.row[next]);
          std::swap(core_[i], core_[next]);
          ++next;
        }
        num_core_[cell] = static_cast<uint32_t>(next - first);
      }
    });
  }

  // Adjacent cells first, by a few samples: that joins nearly all, and joined cells need no test.
  void join_cells() {
    for_each_pair(1, kAdjacentLaterRows, [&](PairSearch&, int64_t a, int64_t b) { return samples_near(a, b); });
    for_each_pair(kReach, static_cast<int>(std::size(kLaterRows)), [&](PairSearch& search, int64_t a, int64_t b) {
      return samples_near(a, b) || search.any(cells_, core_points(a), core_points(b));
    });
  }

  template <class Linked>
  void for_each_pair(int reach, int num_rows, Linked&& linked) {
    constexpr int64_t kCells = 64;  // far fewer than points: one pair of cells can take a millisecond
    parallel_for(context_, cells_.count, kCells, [&](int64_t begin, int64_t end, int64_t) {
      Neighborhood<Key> later(cells_, kLaterRows, reach);
      PairSearch search(limit_);
      for (int64_t a = begin; a < end; ++a) {
        if (num_core_[a] == 0) continue;
        later.move_to(a);
        for (int r = 0; r < num_rows; ++r) {
          const Range row = later.row(r);
          for (int64_t b = r == 0 ? a + 1 : row.begin; b < row.end; ++b) {
            const auto one = static_cast<uint32_t>(a), two = static_cast<uint32_t>(b);
            if (num_core_[b] && !sets_.joined(one, two) && linked(search, a, b)) sets_.join(one, two);
          }
        }
      }
    });
  }

  bool samples_near(int64_t a, int64_t b) const {
    constexpr int64_t kSamples = 4;
    const Range of_a = core_points(a), of_b = core_points(b);
    for (int64_t s = 0; s < kSamples; ++s) {
      const int64_t i = of_a.begin + of_a.size() * s / kSamples;
      for (int64_t t = 0; t < kSamples; ++t) {
        const int64_t j = of_b.begin + of_b.size() * t / kSamples;
        if (math::squared_distance(cells_.x[i], cells_.y[i], cells_.z[i], cells_.x[j], cells_.y[j], cells_.z[j]) <
            limit_)
          return true;
      }
    }
    return false;
  }

  // Number the sets in the order of their lowest core row: leave each set's name at that row, then walk the rows.
  void number_clusters(int64_t* labels) {
    uint32_t* lowest = label_;
    parallel_for(context_, cells_.count, kGrain, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t cell = begin; cell < end; ++cell) {
        lowest[cell] = kNone;
        const Range core = core_points(cell);
        for (int64_t i = core.begin; i < core.end; ++i) lowest[cell] = std::min(lowest[cell], cells_.row[i]);
      }
    });
    Poll poll(context_);
    for (int64_t cell = 0; cell < cells_.count; ++cell) {
      if ((cell & 0xFFFF) == 0) poll.check();
      const uint32_t set = sets_.find(static_cast<uint32_t>(cell));
      lowest[set] = std::min(lowest[set], lowest[cell]);
    }
    parallel_for(context_, cells_.num_points, 1 << 16,
                 [&](int64_t begin, int64_t end, int64_t) { std::fill(labels + begin, labels + end, int64_t{-1}); });
    for (int64_t cell = 0; cell < cells_.count; ++cell)
      if (num_core_[cell] && sets_.find(static_cast<uint32_t>(cell)) == cell) labels[lowest[cell]] = cell;
    uint32_t next = 0;
    for (int64_t row = 0; row < cells_.num_points; ++row)
      if (labels[row] >= 0) label_[labels[row]] = next++;
    // A set is named by its lowest cell, so its label is in place before its other cells ask for it.
    for (int64_t cell = 0; cell < cells_.count; ++cell)
      label_[cell] = num_core_[cell] ? label_[sets_.find(static_cast<uint32_t>(cell))] : kNone;
  }

  void write_labels(int64_t* labels) {
    parallel_for(context_, cells_.num_points, kGrain, [&](int64_t begin, int64_t end, int64_t) {
      Neighborhood<Key> around(cells_, kAllRows);
      for_each_cell(cells_, begin, end, [&](int64_t cell, int64_t first, int64_t last) {
        const int64_t core_end = core_points(cell).end;
        if (last > core_end) around.move_to(cell);
        for (int64_t i = first; i < last; ++i) {
          // All of a cell is in reach of its core points.
          const uint32_t label = i < core_end ? label_[cell] : lowest_label_near(around, i, label_[cell]);
          labels[cells_.row[i]] = label == kNone ? int64_t{-1} : int64_t{label};
        }
      });
    });
  }

  uint32_t lowest_label_near(Neighborhood<Key>& around, int64_t i, uint32_t lowest) const {
    const float q[3] = {cells_.x[i], cells_.y[i], cells_.z[i]};
    for (int r = 0; r < static_cast<int>(std::size(kAllRows)); ++r) {
      const Range row = around.row(r);
      for (int64_t cell = row.begin; cell < row.end; ++cell)
        if (label_[cell] < lowest && count_near(cells_, core_points(cell), q, limit_, 1)) lowest = label_[cell];
    }
    return lowest;
  }

  const pc_context& context_;
  const Cells<Key>& cells_;
  const float limit_;
  const int64_t min_points_;
  uint8_t* core_;       // (n,) 1 = core point
  uint32_t* num_core_;  // (C,) they stand first in their cell
  UnionFind sets_;      // of cells with core points
  uint32_t* label_;     // (C,) kNone = no core points
};

template <class Key>
void cluster(const pc_context& context, ScratchFrame& scratch, const Lattice& lattice, const float* points,
             int64_t count, float limit, int64_t min_points, int64_t* labels) {
  const Cells<Key> cells = sort_into_cells<Key>(context, scratch, lattice, points, nullptr, count);
  Clustering<Key>(context, scratch, cells, limit, min_points).run(labels);
}

// Label one cloud; returns its largest cell coordinate, and labels nothing when that is too large.
double cluster_cloud(const pc_context& context, const float* points, int64_t count, float eps, int64_t min_points,
                     int64_t* labels) {
  ScratchFrame scratch;
  const math::Bounds box = parallel_bounds(context, points, count);
  const double side = cell_side(eps);
  const double largest = largest_coordinate(box, side);
  if (largest >= kMostCellsPerAxis) return largest;
  const Lattice lattice(box, side);
  if (lattice.fits_narrow())
    cluster<NarrowKey>(context, scratch, lattice, points, count, eps * eps, min_points, labels);
  else
    cluster<WideKey>(context, scratch, lattice, points, count, eps * eps, min_points, labels);
  return largest;
}

}  // namespace
}  // namespace pc::cells

PC_EXPORT int32_t pc_dbscan(const pc_context* context, const float* points, const int64_t* ptr, int64_t clouds,
                            double eps, int64_t min_points, int64_t* labels, double* largest) {
  using namespace pc;
  using namespace pc::cells;
  return guarded([&] {
    std::atomic<double> most{0};
    for_each_cloud(*context, ptr, clouds, [&](const pc_context& own, int64_t first, int64_t count) {
      raise_to(most,
               cluster_cloud(own, points + 3 * first, count, static_cast<float>(eps), min_points, labels + first));
    });
    *largest = most.load();
  });
}
