// The search for a plane that stops once a better one is unlikely to be missed, on some of the points of large clouds.
#pragma once

#include <cmath>

#include "pc/planes/scored_points.hpp"

namespace pc::planes {

struct Chance {
  double distance, missed;  // log(1 - probability)
  int64_t not_drawn;        // of the first planes
};

// Counts points near planes, some of these at a time, in their order.
class Tries {
 public:
  Tries(const pc_context& context, const ScoredPoints& points, const Chance& chance)
      : context_(context), points_(points), chance_(chance) {}

  // Call make(first, some) before planes [first, first + some) are looked at, and record(plane, count) for each that
  // competes and has more points near it than all before, until one more try is unlikely to find a better one.
  template <class Make, class Record>
  void run(const Plane* planes, const uint8_t* competes, int64_t num_planes, const Make& make,
           const Record& record) const {
    int64_t best = 0;
    const auto size = static_cast<double>(points_.size());
    for (int64_t first = 0; first < num_planes; first += kTries) {
      int64_t found[kTries];
      const int64_t some = std::min(kTries, num_planes - first);
      make(first, some);
      count(planes + first, some, best, found);
      for (int64_t k = 0; k < some; ++k) {
        const int64_t at = first + k;
        if (competes[at] && found[k] > best) {
          best = found[k];
          record(at, best);
        }
        const double share = static_cast<double>(best) / size;
        const double needed = chance_.missed / std::log1p(-(share * share * share));
        if (static_cast<double>(at + 1 - chance_.not_drawn) >= needed) return;
      }
    }
  }

 private:
  static constexpr int64_t kTries = 32;    // planes counted before it is looked whether they are enough
  static constexpr int64_t kTogether = 4;  // of them, on a block of points
  static constexpr int64_t kGrain = 2;     // times so many that one thread takes at a time

  // Count the points near some planes; of one that cannot have more than `floor`, perhaps only some of them.
  void count(const Plane* planes, int64_t some, int64_t floor, int64_t* counts) const {
    std::fill_n(counts, some, 0);
    const int64_t groups = (some + kTogether - 1) / kTogether;
    parallel_for(context_, groups, kGrain, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t group = begin; group < end; ++group) {
        const int64_t first = group * kTogether;
        count_together(planes + first, std::min(kTogether, some - first), floor, counts + first);
      }
    });
  }

  void count_together(const Plane* planes, int64_t some, int64_t floor, int64_t* counts) const {
    int64_t rest = points_.size();
    for (int64_t b = 0; b < points_.num_blocks(); ++b) {
      count_near_all(points_.block(b), planes, some, static_cast<float>(chance_.distance), counts);
      rest -= points_.block(b).count;
      if (*std::max_element(counts, counts + some) + rest <= floor) return;
    }
  }

  const pc_context& context_;
  const ScoredPoints& points_;
  Chance chance_;
};

}  // namespace pc::planes
