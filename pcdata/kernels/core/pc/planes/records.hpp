// Which of many planes have more points near them than all before.
#pragma once

#include <atomic>

#include "pc/planes/clouds.hpp"
#include "pc/planes/offset_histogram.hpp"

namespace pc::planes {

// Points that one thread takes at a time: 1000 hypotheses on them take about 2 ms.
constexpr int64_t kCountedPiece = 8 * PointBlock::kSize;
static_assert(kCountedPiece == kSmallCloud);

// Counts of all planes on points [begin, end).
inline void count_piece(const float* points, int64_t begin, int64_t end, const Plane* planes, int64_t num_planes,
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
    } else if (!find_by_histogram() && !find_by_runs()) {
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
  static constexpr int64_t kPlanes = 16;                              // that one thread takes at a time: some 100 us
  static constexpr int64_t kManyPoints = 1 << 15, kManyPlanes = 128;  // from here on a histogram is soon paid back
  static constexpr int64_t kSampleBits = 12;

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
    std::fill_n(counts_, num_planes_, 0);
    std::vector<Candidate> some;
    int64_t least = floor_;
    for (int64_t h = 0; h < num_planes_; ++h) {
      const CountBounds& own = bounds[static_cast<size_t>(h)];
      if (own.most > least) some.push_back({h, least});
      least = std::max(least, own.least);
    }
    count_candidates(some);
    return true;
  }

  // The same where few of many planes can have as many points as the one that seems best.
  bool find_by_histogram() {
    if (runs_.count == 0 || rows_.size() < kManyPoints || num_planes_ < kManyPlanes) return false;
    ScratchFrame scratch;
    const ScoredPoints sample(runs_.points, runs_.num_points, kSampleBits, scratch);
    std::vector<int64_t> score(static_cast<size_t>(num_planes_), 0);
    parallel_for(context_, num_planes_, 4 * kPlanes, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t b = 0; b < sample.num_blocks(); ++b)
        count_near_all(sample.block(b), planes_ + begin, end - begin, distance_, score.data() + begin);
    });
    std::vector<Candidate> likely;
    int64_t best = 0;
    for (int64_t h = 0; h < num_planes_; ++h)
      if (competes_[h] && score[static_cast<size_t>(h)] > best) {
        best = score[static_cast<size_t>(h)];
        likely.push_back({h, floor_});
      }
    if (likely.empty()) return false;
    const OffsetHistogram histogram(context_, runs_, planes_[likely.back().plane], distance_, sample, scratch);
    if (!histogram.is_known()) return false;
    std::vector<int64_t> most(static_cast<size_t>(num_planes_), 0);
    parallel_for(context_, num_planes_, kPlanes, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t h = begin; h < end; ++h) {
        if (!competes_[h]) continue;
        most[static_cast<size_t>(h)] =
            histogram.sees(planes_[h]) ? histogram.most(planes_[h]) : bound_count(runs_, {planes_[h], distance_}).most;
      }
    });
    std::fill_n(counts_, num_planes_, 0);
    count_candidates(likely);
    std::vector<Candidate> others;
    int64_t least = floor_;
    for (int64_t h = 0; h < num_planes_; ++h) {
      if (counts_[h] == 0 && most[static_cast<size_t>(h)] > least) others.push_back({h, least});
      least = std::max(least, counts_[h]);
    }
    if (static_cast<int64_t>(others.size()) > num_planes_ / 2) return false;
    count_candidates(others);
    return true;
  }

  // A plane that may be a record, and what it must exceed, as far as it is known.
  struct Candidate {
    int64_t plane, floor;
  };

  // Count planes, in order, that are no more than 0 so far; 0 stays where one does not exceed its floor.
  void count_candidates(const std::vector<Candidate>& some) {
    // Counts of planes that others know already: a plane need not be counted once one before it is known to have more.
    std::vector<std::atomic<int64_t>> known(some.size());
    for (auto& one : known) one.store(0, std::memory_order_relaxed);
    parallel_for(context_, static_cast<int64_t>(some.size()), 1, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t c = begin; c < end; ++c) {
        const auto at = static_cast<size_t>(c);
        int64_t floor = some[at].floor;
        for (size_t before = 0; before < at; ++before)
          floor = std::max(floor, known[before].load(std::memory_order_relaxed));
        const int64_t h = some[at].plane;
        const RunTest test(planes_[h], distance_);
        const int64_t most = bound_count(runs_, test).most;
        if (most <= floor) continue;
        counts_[h] = std::max<int64_t>(count_above(runs_, test, planes_[h], distance_, most, floor), 0);
        known[at].store(counts_[h], std::memory_order_relaxed);
      }
    });
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

}  // namespace pc::planes
