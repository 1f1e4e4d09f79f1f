// Planes through triples of points, which of them has more points near it than all before, and marking what is near
// one; for batches of clouds.
#include <atomic>

#include "pc/memory.hpp"
#include "pc/planes/plane_sums.hpp"
#include "pc/planes/runs.hpp"
#include "pc/threads.hpp"

namespace pc::planes {
namespace {

// Points that one thread takes at a time: 1000 hypotheses on them take about 2 ms.
constexpr int64_t kCountedPiece = 8 * PointBlock::kSize;
// Points that one thread marks at a time: 30 us, as long as another thread takes to start.
constexpr int64_t kMarkedRows = 16 * kCountedPiece;

// Which of the points [begin, end) are near a plane.
void mark_near(const float* points, int64_t begin, int64_t end, const Plane& plane, float distance, uint8_t* near) {
  for (int64_t i = begin; i < end; ++i) near[i] = plane.is_near(points + 3 * i, distance);
}

// The same of the points that lie in runs.
void mark_near_runs(const Runs& runs, int64_t begin, int64_t end, const Plane& plane, float distance, uint8_t* near) {
  const RunTest test(plane, distance);
  for (int64_t i = begin; i < end; i += kLanes) {
    const RunMasks masks = test(runs, i);
    const uint32_t inside = masks.inside.bits(), open = masks.open.bits();
    for (int64_t lane = 0; lane < kLanes; ++lane) {
      const int64_t run = i + lane, size = static_cast<int64_t>(runs.size[run]);
      uint8_t* to = near + kRun * run;
      if (!(open >> lane & 1)) {
        std::fill_n(to, size, uint8_t{0});
      } else if (inside >> lane & 1) {
        std::fill_n(to, size, uint8_t{1});
      } else {
        mark_near(runs.points, kRun * run, kRun * run + size, plane, distance, near);
      }
    }
  }
}

// Counts of all planes on points [begin, end).
void count_piece(const float* points, int64_t begin, int64_t end, const Plane* planes, int64_t num_planes,
                 float distance, int64_t* counts) {
  PointBlock block;
  for (int64_t i = begin; i < end; i += PointBlock::kSize) {
    block.read(points, i, std::min<int64_t>(end, i + PointBlock::kSize));
    count_near_all(block, planes, num_planes, distance, counts);
  }
}

// Finds the records among the planes of one cloud: those that have more points near them than all before.
class Records {
 public:
  Records(const pc_context& context, const float* points, Range rows, const Runs& runs, const Plane* planes,
          const uint8_t* competes, int64_t num_planes, float distance, int64_t floor, int64_t* counts)
      : context_(context),
        points_(points),
        rows_(rows),
        runs_(runs),
        planes_(planes),
        competes_(competes),
        num_planes_(num_planes),
        distance_(distance),
        floor_(floor),
        counts_(counts) {}

  void find() {
    if (is_small(rows_)) {
      std::fill_n(counts_, num_planes_, 0);
      count_piece(points_, rows_.begin, rows_.end, planes_, num_planes_, distance_, counts_);
    } else if (!find_by_runs()) {
      count_all();
    }
    for (int64_t h = 0; h < num_planes_; ++h) {
      if (competes_[h] && counts_[h] > floor_)
        floor_ = counts_[h];
      else
        counts_[h] = 0;
    }
  }

  // Small clouds are searched side by side, each by one thread.
  static bool is_small(Range rows) { return rows.size() <= kCountedPiece; }

 private:
  static constexpr int64_t kPlanes = 16;  // that one thread takes at a time: some 100 us

  // False where the runs say too little about the points to be worth it.
  bool find_by_runs() {
    if (runs_.count == 0) return false;
    std::vector<CountBounds> bounds(static_cast<size_t>(num_planes_), {0, 0});
    parallel_for(context_, num_planes_, kPlanes, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t h = begin; h < end; ++h)
        if (competes_[h]) bounds[static_cast<size_t>(h)] = bound_count(runs_, {planes_[h], distance_});
    });
    int64_t open = 0, total = 0;
    for (int64_t h = 0; h < num_planes_; ++h) {
      open += bounds[static_cast<size_t>(h)].most - bounds[static_cast<size_t>(h)].least;
      total += competes_[h] ? rows_.size() : 0;
    }
    if (open > total / 2) return false;
    std::vector<int64_t> some;    // planes that may be records,
    std::vector<int64_t> floors;  // and what they must exceed, as far as it is known
    int64_t least = floor_;
    for (int64_t h = 0; h < num_planes_; ++h) {
      const CountBounds& own = bounds[static_cast<size_t>(h)];
      counts_[h] = 0;
      if (own.most > least) some.push_back(h), floors.push_back(least);
      least = std::max(least, own.least);
    }
    // Counts of planes that others know already: a plane need not be counted once one before it is known to have more.
    std::vector<std::atomic<int64_t>> known(some.size());
    for (auto& one : known) one.store(0, std::memory_order_relaxed);
    parallel_for(context_, static_cast<int64_t>(some.size()), 1, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t c = begin; c < end; ++c) {
        const auto at = static_cast<size_t>(c);
        int64_t floor = floors[at];
        for (size_t before = 0; before < at; ++before)
          floor = std::max(floor, known[before].load(std::memory_order_relaxed));
        const int64_t h = some[at], most = bounds[static_cast<size_t>(h)].most;
        if (most <= floor) continue;
        const int64_t count = count_above(runs_, {planes_[h], distance_}, planes_[h], distance_, most, floor);
        counts_[h] = std::max<int64_t>(count, 0);
        known[at].store(counts_[h], std::memory_order_relaxed);
      }
    });
    return true;
  }

  void count_all() {
    ScratchFrame scratch;
    const int64_t num_pieces = (rows_.size() + kCountedPiece - 1) / kCountedPiece;
    int64_t* own = scratch.take<int64_t>(num_pieces * num_planes_);  // (piece, plane)
    parallel_for(context_, num_pieces, 1, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t p = begin; p < end; ++p) {
        const int64_t first = rows_.begin + p * kCountedPiece;
        std::fill_n(own + p * num_planes_, num_planes_, 0);
        count_piece(points_, first, std::min<int64_t>(rows_.end, first + kCountedPiece), planes_, num_planes_,
                    distance_, own + p * num_planes_);
      }
    });
    std::fill_n(counts_, num_planes_, 0);
    for (int64_t p = 0; p < num_pieces; ++p)
      for (int64_t h = 0; h < num_planes_; ++h) counts_[h] += own[p * num_planes_ + h];
  }

  const pc_context& context_;
  const float* points_;
  Range rows_;
  Runs runs_;
  const Plane* planes_;
  const uint8_t* competes_;
  int64_t num_planes_;
  float distance_;
  int64_t floor_;
  int64_t* counts_;
};

}  // namespace
}  // namespace pc::planes

PC_EXPORT int32_t pc_planes_of_triples(const pc_context* context, const float* points, const int64_t* ptr,
                                       int64_t num_clouds, const int64_t* triples, int64_t count, const int64_t* which,
                                       double flat, double* planes) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    constexpr int64_t kPlanes = 1 << 14;  // that one thread makes at a time
    const int64_t clouds = std::max<int64_t>(1, kPlanes / std::max<int64_t>(1, count));
    parallel_for(*context, num_clouds, clouds, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t cloud = first; cloud < last; ++cloud) {
        const float* own = points + 3 * ptr[cloud];
        const int64_t* triple = triples + 3 * count * which[cloud];
        for (int64_t h = 0; h < count; ++h, triple += 3)
          math::plane_through(math::vector_of(own + 3 * triple[0]), math::vector_of(own + 3 * triple[1]),
                              math::vector_of(own + 3 * triple[2]), flat, planes + 4 * (cloud * count + h));
      }
    });
  });
}

PC_EXPORT int32_t pc_bound_runs(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                                const int64_t* run_ptr, float* runs) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const int64_t num_runs = run_ptr[num_clouds];
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud)
      parallel_for(*context, run_ptr[cloud + 1] - run_ptr[cloud], 256, [&](int64_t begin, int64_t end, int64_t) {
        for (int64_t r = begin; r < end; ++r)
          bound_run(points + 3 * ptr[cloud], ptr[cloud + 1] - ptr[cloud], r, runs + run_ptr[cloud] + r, num_runs);
      });
  });
}

PC_EXPORT int32_t pc_record_planes(const pc_context* context, const float* points, const int64_t* ptr,
                                   int64_t num_clouds, const int64_t* run_ptr, const float* runs, const float* planes,
                                   const uint8_t* competes, int64_t num_planes, double distance, const int64_t* floors,
                                   int64_t* counts) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const auto* all = reinterpret_cast<const Plane*>(planes);
    const auto rows_of = [&](int64_t cloud) { return Range{ptr[cloud], ptr[cloud + 1]}; };
    const auto find = [&](int64_t cloud) {
      const Range own = run_ptr == nullptr ? Range{0, 0} : Range{run_ptr[cloud], run_ptr[cloud + 1]};
      const Runs mine(runs, run_ptr == nullptr ? 0 : run_ptr[num_clouds], own, points, rows_of(cloud));
      Records(*context, points, rows_of(cloud), mine, all + cloud * num_planes, competes + cloud * num_planes,
              num_planes, static_cast<float>(distance), floors[cloud], counts + cloud * num_planes)
          .find();
    };
    parallel_for(*context, num_clouds, 16, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t cloud = begin; cloud < end; ++cloud)
        if (Records::is_small(rows_of(cloud))) find(cloud);
    });
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud)
      if (!Records::is_small(rows_of(cloud))) find(cloud);
  });
}

PC_EXPORT int32_t pc_near_planes(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                                 const int64_t* run_ptr, const float* runs, const float* planes, double distance,
                                 uint8_t* near) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const auto limit = static_cast<float>(distance);
    const auto* all = reinterpret_cast<const Plane*>(planes);
    for_each_piece(
        *context, cut_clouds(ptr, num_clouds, kCountedPiece), kCountedPiece, [&](const CloudPiece& piece, int64_t) {
          const int64_t own = piece.cloud;
          if (run_ptr == nullptr || run_ptr[own] == run_ptr[own + 1]) {
            mark_near(points, piece.begin, piece.end, all[own], limit, near);
            return;
          }
          const Runs mine(runs, run_ptr[num_clouds], {run_ptr[own], run_ptr[own + 1]}, points,
                          {ptr[own], ptr[own + 1]});
          const int64_t first = (piece.begin - ptr[own]) / kRun;  // pieces are whole groups of runs
          mark_near_runs(mine, first, first + runs_of(piece.end - piece.begin), all[own], limit, near + ptr[own]);
        });
  });
}
