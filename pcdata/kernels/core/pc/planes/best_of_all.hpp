// Which of many planes has the most points near it.
#pragma once

#include <atomic>

#include "pc/planes/clouds.hpp"
#include "pc/planes/offset_histogram.hpp"

namespace pc::planes {

// Points that one thread takes at a time: 1000 hypotheses on them take about 2 ms.
constexpr int64_t kCountedPiece = 8 * PointBlock::kSize;
static_assert(kCountedPiece == kSmallCloud);

// A plane by its number, and the points near it.
struct Best {
  int64_t plane = 0, near = 0;
};

// Finds the best of many planes of a cloud; points are counted of those that may have more than all before.
class BestOfAll {
 public:
  BestOfAll(const pc_context& context, const Runs& runs, const Plane* planes, const uint8_t* competes,
            int64_t num_planes, float distance)
      : context_(context),
        runs_(runs),
        planes_(planes),
        competes_(competes),
        num_planes_(num_planes),
        distance_(distance) {}

  // The plane with the most points near it, of those that compete; the first of equals.
  Best find(ScratchFrame& scratch) {
    counts_ = scratch.take<int64_t>(num_planes_);
    // Runs of a small cloud tell too little to be worth a look.
    const bool is_large = runs_.num_points > kSmallCloud;
    if (!is_large || (!find_by_histogram() && !find_by_runs())) count_all();
    Best best;
    for (int64_t h = 0; h < num_planes_; ++h)
      if (competes_[h] && counts_[h] > best.near) best = {h, counts_[h]};
    return best;
  }

 private:
  static constexpr int64_t kPlanes = 16;                              // that one thread takes at a time: some 100 us
  static constexpr int64_t kManyPoints = 1 << 15, kManyPlanes = 128;  // from here on a histogram is soon paid back
  static constexpr int64_t kSampleBits = 12;

  // False where the runs say too little about the points to be worth it.
  bool find_by_runs() {
    std::vector<CountBounds> bounds(static_cast<size_t>(num_planes_), {0, 0});
    parallel_for(context_, num_planes_, kPlanes, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t h = begin; h < end; ++h)
        if (competes_[h]) bounds[static_cast<size_t>(h)] = bound_count(runs_, {planes_[h], distance_});
    });
    int64_t open = 0, total = 0;
    for (int64_t h = 0; h < num_planes_; ++h) {
      open += bounds[static_cast<size_t>(h)].most - bounds[static_cast<size_t>(h)].least;
      total += competes_[h] ? runs_.num_points : 0;
    }
    if (open > total / 2) return false;
    std::fill_n(counts_, num_planes_, 0);
    std::vector<Candidate> some;
    int64_t least = 0;
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
    if (runs_.num_points < kManyPoints || num_planes_ < kManyPlanes) return false;
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
        likely.push_back({h, 0});
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
    int64_t least = 0;
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
    const int64_t num_pieces = (runs_.num_points + kCountedPiece - 1) / kCountedPiece;
    int64_t* own = scratch.take<int64_t>(num_pieces * num_planes_);  // (piece, plane)
    parallel_for(context_, num_pieces, 1, [&](int64_t begin, int64_t end, int64_t) {
      PointBlock block;
      for (int64_t p = begin; p < end; ++p) {
        int64_t* counts = own + p * num_planes_;
        std::fill_n(counts, num_planes_, 0);
        const int64_t last = std::min(runs_.num_points, (p + 1) * kCountedPiece);
        for (int64_t i = p * kCountedPiece; i < last; i += PointBlock::kSize) {
          block.read(runs_.points, i, std::min<int64_t>(last, i + PointBlock::kSize));
          count_near_all(block, planes_, num_planes_, distance_, counts);
        }
      }
    });
    std::fill_n(counts_, num_planes_, 0);
    for (int64_t p = 0; p < num_pieces; ++p)
      for (int64_t h = 0; h < num_planes_; ++h) counts_[h] += own[p * num_planes_ + h];
  }

  const pc_context& context_;
  const Runs& runs_;
  const Plane* planes_;
  const uint8_t* competes_;
  int64_t num_planes_;
  float distance_;
  int64_t* counts_ = nullptr;
};

}  // namespace pc::planes
