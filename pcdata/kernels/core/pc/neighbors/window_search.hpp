// The search of a cloud that still lies on a depth image: a window of pixels, with proof that nothing nearer lies
// outside. Queries without a proof go to the box tree.
#pragma once

#include <algorithm>
#include <cstdlib>
#include <vector>

#include "pc/neighbors/window_proof.hpp"

namespace pc::neighbors {

// The pixels at each distance from the middle of a window, square ring by square ring, nearest first within a ring.
class WindowRings {
 public:
  explicit WindowRings(int max_reach) {
    for (int ring = 0; ring <= max_reach; ++ring) {
      begin_.push_back(offsets_.size());
      for (int dv = -ring; dv <= ring; ++dv)
        for (int du = -ring; du <= ring; ++du)
          if (std::max(std::abs(du), std::abs(dv)) == ring) offsets_.push_back({du, dv});
      std::stable_sort(offsets_.begin() + static_cast<ptrdiff_t>(begin_.back()), offsets_.end(),
                       [](Offset a, Offset b) { return a.squared() < b.squared(); });
    }
    begin_.push_back(offsets_.size());
  }
  struct Offset {
    int du, dv;
    int squared() const { return du * du + dv * dv; }
  };
  const Offset* begin(int ring) const { return offsets_.data() + begin_[static_cast<size_t>(ring)]; }
  const Offset* end(int ring) const { return begin(ring + 1); }

 private:
  std::vector<Offset> offsets_;
  std::vector<size_t> begin_;
};

// Searches windows around sixteen pixels side by side.
class WindowSearch {
 public:
  WindowSearch(const OrganizedCloud& cloud, const WindowRings& rings) : cloud_(cloud), rings_(rings) {}

  // The points at pixels (u, v) to (u+15, v).
  QueryGroup queries_at(int64_t u, int64_t v) const {
    const int64_t at = v * cloud_.stride() + u;
    return QueryGroup(cloud_.x() + at, cloud_.y() + at, cloud_.z() + at);
  }

  // Offer windows of growing size, from `reach` on; return the lanes that are proved complete.
  template <class Nearest>
  PackMask run(const QueryGroup& queries, int64_t u, int64_t v, int reach, Nearest& nearest) {
    u_ = u;
    v_ = v;
    for (int ring = 0; ring <= reach; ++ring) offer_ring(queries, ring, nearest);
    const Place place(cloud_, queries, u, v);
    for (;; offer_ring(queries, ++reach, nearest)) {
      nearest.settle();
      reach_ = reach;
      const PackMask proved = less(nearest.bound(), place.clear_within(reach)) & queries.active;
      if (proved == queries.active || reach == cloud_.max_reach()) return proved;
      // Rings cost all lanes: go on only for those that the largest window would prove.
      if ((less(nearest.bound(), place.clear_within(cloud_.max_reach())) & queries.active & ~proved) == 0)
        return proved;
    }
  }

  // Show again every pixel of the last window: body(x, y, z, id), where row_in_lane(id, lane) is the point's row.
  template <class Body>
  void replay(const QueryGroup&, const FloatPack&, Body&& body) const {
    for (int ring = 0; ring <= reach_; ++ring)
      for (auto offset = rings_.begin(ring); offset != rings_.end(ring); ++offset) {
        const int64_t at = pixel(*offset);
        body(FloatPack::load(cloud_.x() + at), FloatPack::load(cloud_.y() + at), FloatPack::load(cloud_.z() + at),
             static_cast<uint32_t>(at));
      }
  }
  uint32_t row(uint32_t id) const { return cloud_.row(id); }
  // The pixel of lane 0 may lie in the margin before the image, so that its number is negative and its id has wrapped:
  // the lane is added in 32 bits, where it wraps back.
  uint32_t row_in_lane(uint32_t id, int lane) const { return cloud_.row(id + static_cast<uint32_t>(lane)); }

 private:
  template <class Nearest>
  void offer_ring(const QueryGroup& queries, int ring, Nearest& nearest) const {
    for (auto offset = rings_.begin(ring); offset != rings_.end(ring); ++offset) {
      const int64_t at = pixel(*offset);
      const FloatPack squared =
          squared_length(FloatPack::load(cloud_.x() + at) - queries.x, FloatPack::load(cloud_.y() + at) - queries.y,
                         FloatPack::load(cloud_.z() + at) - queries.z);
      if (nearest.wants(squared)) nearest.offer(squared, Ids::ascending(static_cast<uint32_t>(at)));
    }
  }

  int64_t pixel(const WindowRings::Offset& offset) const { return (v_ + offset.dv) * cloud_.stride() + u_ + offset.du; }

  const OrganizedCloud& cloud_;
  const WindowRings& rings_;
  int64_t u_ = 0, v_ = 0;
  int reach_ = 0;
};

}  // namespace pc::neighbors
