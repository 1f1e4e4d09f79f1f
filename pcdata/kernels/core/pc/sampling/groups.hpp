// Leaves for farthest point sampling from points that follow each other in space as they do in memory.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "pc/sampling/farthest.hpp"

namespace pc::sampling {

// On a depth image, points side by side in memory are pixels side by side. Of such a cloud eight at a time are sorted
// as one, by the middle of their box. Groups much wider than most, as those over an edge are, would spoil the boxes of
// their leaves: their points are sorted one by one. Any order gives the same picks; this one takes a third of the time.
class PointGroups {
 public:
  PointGroups(const pc_context& context, ScratchFrame& scratch, FarthestSampler& sampler)
      : context_(context), scratch_(scratch), sampler_(sampler), count_(sampler.count() / kGroup) {}

  // Put all points in order; false, and nothing is done, where the given order says too little of where they lie.
  bool put_in_order() {
    if (sampler_.count() < kFewPoints || !(find_widest() >= 0)) return false;
    sort_out();
    const auto num_loose = static_cast<int64_t>(loose_.size());
    if (num_loose > sampler_.count() / 4) return false;
    sort::MortonPoints order(scratch_, std::max(num_narrow_, num_loose));
    sorted_ = scratch_.take<uint32_t>(num_narrow_);
    order.parallel(context_, scratch_, middle_, num_narrow_,
                   [&](const sort::PlacedPoint* groups, int64_t count, int64_t at) {
                     for (int64_t i = 0; i < count; ++i) sorted_[at + i] = narrow_[groups[i].row()];
                   });
    if (loose_.empty()) return true;
    auto* points = scratch_.take<float>(3 * num_loose);
    for (size_t i = 0; i < loose_.size(); ++i) std::copy_n(sampler_.points() + 3 * loose_[i], 3, points + 3 * i);
    order.serial(points, num_loose, 0, [&](const sort::PlacedPoint* some, int64_t count, int64_t at) {
      for (int64_t i = 0; i < count; ++i) sampler_.place_one(loose_[some[i].row()], kGroup * num_narrow_ + at + i);
    });
    return true;
  }

  // Once they are in order: place the points of some groups of leaves. Groups are independent of one another.
  void place(int64_t begin, int64_t end) {
    constexpr int64_t kEach = kLeaf * kFan / kGroup, kAhead = 8;
    const int64_t last = std::min(end * kEach, num_narrow_);
    for (int64_t at = begin * kEach; at < last; ++at) {
      const float* soon = sampler_.points() + 3 * kGroup * sorted_[std::min(at + kAhead, num_narrow_ - 1)];
      __builtin_prefetch(soon);
      __builtin_prefetch(soon + 3 * kGroup - 1);
      sampler_.place_eight(kGroup * int64_t{sorted_[at]}, kGroup * at);
    }
  }

 private:
  static constexpr int64_t kGroup = FarthestSampler::kSideBySide;
  static constexpr int64_t kFewPoints = 1 << 13;  // the usual order takes no longer
  static constexpr int64_t kPiece = 1024;         // groups measured by one thread
  static constexpr int64_t kLooked = 256;         // groups that tell of all

  // Middle and half the longest side of a group's box.
  struct Extent {
    float middle[3], half;
  };

  Extent extent(int64_t group) const {
    const float* p = sampler_.points() + 3 * kGroup * group;
    auto low = load<sort::Float4>(p), high = low;
    const auto include = [&](sort::Float4 point) {
      low = point < low ? point : low;
      high = point > high ? point : high;
    };
    for (int i = 1; i + 1 < kGroup; ++i) include(load<sort::Float4>(p + 3 * i));
    // What follows the last point may be no memory of the cloud's: read it with the number before it.
    const auto last = load<sort::Float4>(p + 3 * kGroup - 4);
    include(sort::Float4{last[1], last[2], last[3], last[3]});
    const sort::Float4 middle = 0.5F * low + 0.5F * high, half = 0.5F * high - 0.5F * low;
    return {{middle[0], middle[1], middle[2]}, std::max(std::max(std::max(0.0F, half[0]), half[1]), half[2])};
  }

  static float median(std::vector<float>& numbers) {
    const auto middle = numbers.begin() + static_cast<int64_t>(numbers.size() / 2);
    std::nth_element(numbers.begin(), middle, numbers.end());
    return *middle;
  }

  // How wide a group may be, or -1 where groups are no pieces of a surface: a row of pixels is some 16 / sqrt(n) as
  // wide as most of the cloud.
  float find_widest() {
    constexpr float kMostOfCloud = 48, kMostOfUsual = 3;
    std::vector<float> half, at[3], off;
    for (int64_t i = 0; i < kLooked; ++i) {
      const Extent own = extent(i * count_ / kLooked);
      half.push_back(own.half);
      for (int axis = 0; axis < 3; ++axis) at[axis].push_back(own.middle[axis]);
    }
    float spread = 0;
    for (auto& along : at) {
      std::vector<float> sorted = along;
      const float center = median(sorted);
      off.clear();
      for (const float one : along) off.push_back(std::fabs(one - center));
      spread = std::max(spread, median(off));
    }
    const float usual = median(half), most = kMostOfCloud * spread / std::sqrt(static_cast<float>(sampler_.count()));
    widest_ = usual <= most ? kMostOfUsual * usual : -1;
    return widest_;
  }

  // Put the middles of narrow groups together, and list the points of all others.
  void sort_out() {
    middle_ = scratch_.take<float>(3 * count_);
    narrow_ = scratch_.take<uint32_t>(count_);
    std::vector<int64_t> found(static_cast<size_t>((count_ + kPiece - 1) / kPiece));
    parallel_for(context_, count_, kPiece, [&](int64_t begin, int64_t end, int64_t) {
      int64_t to = begin;
      for (int64_t group = begin; group < end; ++group) {
        const Extent own = extent(group);
        std::copy_n(own.middle, 3, middle_ + 3 * to);
        narrow_[to] = static_cast<uint32_t>(group);
        to += own.half <= widest_ ? 1 : 0;
      }
      found[static_cast<size_t>(begin / kPiece)] = to - begin;
    });
    int64_t next = 0;  // group
    const auto loosen_until = [&](int64_t row) {
      for (int64_t i = kGroup * next; i < row; ++i) loose_.push_back(static_cast<uint32_t>(i));
    };
    for (size_t piece = 0; piece < found.size(); ++piece) {
      const int64_t begin = static_cast<int64_t>(piece) * kPiece;
      std::memmove(middle_ + 3 * num_narrow_, middle_ + 3 * begin, static_cast<size_t>(found[piece]) * 12);
      for (int64_t i = 0; i < found[piece]; ++i) {
        const uint32_t group = narrow_[begin + i];
        loosen_until(kGroup * group);
        next = int64_t{group} + 1;
        narrow_[num_narrow_++] = group;
      }
    }
    loosen_until(sampler_.count());
  }

  const pc_context& context_;
  ScratchFrame& scratch_;
  FarthestSampler& sampler_;
  int64_t count_;
  float widest_ = -1;
  float* middle_ = nullptr;     // of narrow groups
  uint32_t* narrow_ = nullptr;  // groups
  uint32_t* sorted_ = nullptr;  // the same in order
  int64_t num_narrow_ = 0;
  std::vector<uint32_t> loose_;  // rows
};

}  // namespace pc::sampling
