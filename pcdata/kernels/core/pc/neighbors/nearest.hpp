// What a search for sixteen queries at once is made of, one query per lane.
//
// A search offers candidates one after another to all lanes; each lane keeps the nearest. All kinds share a contract:
//   start(k, limit)      lane l will keep the k nearest with d2 <= limit[l]; a limit of -infinity switches a lane off
//   wants(squared)       the lanes that this candidate could change
//   offer(squared, ids)  take a candidate: its squared distance to every lane's query, its id for every lane
//   settle()             bound() may lag behind the last offers; now it does not
//   bound(), widest()    no candidate farther than this changes the lane; any lane
//   finish()             call once at the end; then bound() is the k-th squared distance, or the limit
#pragma once

#include <limits>

#include "pc/pack.hpp"

namespace pc::neighbors {

// Queries searched at once, one per lane.
constexpr int kQueries = kPackLanes;
constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr float kOff = -kInfinity;

// Candidate ids per lane.
struct Ids {
  alignas(64) uint32_t lane[kQueries];

  static Ids same(uint32_t id) {
    Ids ids;
    for (uint32_t& lane : ids.lane) lane = id;
    return ids;
  }
  static Ids ascending(uint32_t first) {
    Ids ids;
    for (int i = 0; i < kQueries; ++i) ids.lane[i] = first + static_cast<uint32_t>(i);
    return ids;
  }
};

constexpr uint32_t kNoId = ~uint32_t{0};

}  // namespace pc::neighbors
