// Picks of several clouds at once, each by a sampler of its own.
#pragma once

#include <algorithm>
#include <vector>

#include "pc/threads.hpp"

namespace pc::sampling {

// Picks that are taken so far of those wanted.
template <class Sampler>
struct Picking {
  Sampler sampler;
  int64_t* picks;
  int64_t wanted, taken = 0;
};

// Take all that are wanted; after every `budget` of work of a cloud Ctrl-C is looked for.
template <class Sampler>
void take_picks(const pc_context& context, std::vector<Picking<Sampler>>& open, int64_t budget) {
  while (!open.empty()) {
    parallel_for(context, static_cast<int64_t>(open.size()), 1, [&](int64_t i, int64_t, int64_t) {
      Picking<Sampler>& own = open[static_cast<size_t>(i)];
      own.taken = own.sampler.advance(own.picks, own.taken, own.wanted, budget);
    });
    open.erase(std::remove_if(open.begin(), open.end(), [](const auto& own) { return own.taken == own.wanted; }),
               open.end());
  }
}

}  // namespace pc::sampling
