// The distances to the nearest points of a cloud on a depth image, sixteen pixels at a time.
#pragma once

#include "pc/neighbors/batch_search.hpp"
#include "pc/neighbors/image_boxes.hpp"
#include "pc/neighbors/sorted_columns.hpp"

namespace pc::neighbors {

// The smallest squared distances to pixels around sixteen queries, the queries themselves left out.
//
// A list per lane holds `wanted` numbers in whole blocks of rows, those before them -infinity. What is least of two
// ascending lists is least of the pairs of one's first with the other's last, its second with the other's last but one,
// ...; that rises and then falls, and is sorted again only when more follows.
class WindowList {
 public:
  static constexpr int kMost = kMostBlocks * kBlockRows;

  void start(int wanted) {
    wanted_ = wanted;
    blocks_ = (wanted + kBlockRows - 1) / kBlockRows;
    for (int i = 0; i < before(); ++i) FloatPack(-kInfinity).store(list_[i]);
    is_empty_ = is_sorted_ = true;
  }

  // Take the squared distances body(0), ... body(count - 1); those that could not change any of the lanes may be
  // missed.
  template <class Body>
  void take(int count, PackMask lanes, Body body) {
    int next = 0;
    if (is_empty_) {
      is_empty_ = false;
      for (; next < std::min(count, size()); ++next) body(next).store(list_[before() + next]);
      for (int i = next; i < size(); ++i) FloatPack(kInfinity).store(list_[before() + i]);
      sort_columns(list_ + before(), (next + kBlockRows - 1) / kBlockRows);
      bound_ = FloatPack::load(list_[size() - 1]);
    }
    if (__builtin_popcount(lanes) > kFew) {
      while (next < count) {
        const int some = std::min(count - next, size());
        for (int i = 0; i < some; ++i) body(next + i).store(taken_[i]);
        next += some;
        merge(some);
      }
      return;
    }
    int taken = 0;
    for (; next < count; ++next) {
      const FloatPack squared = body(next);
      squared.store(taken_[taken]);
      taken += (less(squared, bound_) & lanes) != 0;
      if (taken == size()) {
        merge(taken);
        taken = 0;
      }
    }
    if (taken != 0) merge(taken);
  }

  // The largest that is wanted.
  const FloatPack& bound() const { return bound_; }
  // (wanted, 16) in no order.
  const Row* squared() const { return list_ + before(); }

 private:
  // Lanes for which it pays to look whether a number matters before it is sorted.
  static constexpr int kFew = 10;

  int size() const { return blocks_ * kBlockRows; }
  int before() const { return size() - wanted_; }

  void merge(int taken) {
    const int blocks = (taken + kBlockRows - 1) / kBlockRows, count = std::min(blocks * kBlockRows, wanted_);
    for (int i = taken; i < blocks * kBlockRows; ++i) FloatPack(kInfinity).store(taken_[i]);
    sort_columns(taken_, blocks);
    if (!is_sorted_) sort_rising_falling(list_, blocks_);
    FloatPack most = count < wanted_ ? FloatPack::load(list_[size() - 1 - count]) : FloatPack(-kInfinity);
    for (int i = 0; i < count; ++i) {
      Row& own = list_[size() - 1 - i];
      const FloatPack lesser = minimum(FloatPack::load(own), FloatPack::load(taken_[i]));
      lesser.store(own);
      most = maximum(lesser, most);
    }
    bound_ = most;
    is_sorted_ = false;
  }

  alignas(64) Row list_[kMost + kBlockRows];  // the first chunk may stand up to seven rows later
  alignas(64) Row taken_[kMost];
  FloatPack bound_{kInfinity};
  int wanted_ = 0, blocks_ = 0;
  bool is_empty_ = true, is_sorted_ = true;
};

// Sixteen queries whose neighbors were found one by one.
struct Stragglers {
  alignas(64) float squared[StragglerSearch::kMost][kQueries];
  uint32_t row[kQueries];
  int number = 0, longest = 0, length[kQueries];

  // Take the squared distances below a bound, the query itself among them; the bound stands in for those that are
  // missing.
  void add(uint32_t query, const StragglerSearch& search, int others) {
    bool is_itself = true;
    int count = 0;
    for (int i = 0; i < search.count(); ++i) {
      squared[count][number] = search.squared()[i];
      const bool leave_out = is_itself && search.squared()[i] == 0;
      is_itself &= !leave_out;
      count += !leave_out;
    }
    for (; count < others; ++count) squared[count][number] = search.bound();
    row[number] = query;
    length[number++] = count;
    longest = std::max(longest, count);
  }
};

// Calls for every query of the cloud, in no order, task(squared, lanes, row) with the squared distances to its nearest
// others: (k - 1, 16) in no order, infinity where there are fewer. Those that would take too much work it returns.
template <class Task>
class WindowDistances {
 public:
  // The half-width that windows have at most.
  static int max_reach(int k) { return first_reach(k) + kMoreRings; }

  WindowDistances(const OrganizedCloud& cloud, int k, const Task& task)
      : cloud_(cloud), k_(k), task_(task), rings_(max_reach(k)) {}

  int64_t run(const pc_context& context, ScratchFrame& scratch, int64_t count, Unproved* rest) {
    const ImageBoxes boxes(context, scratch, cloud_);
    std::atomic<int64_t> num_rest{0}, work{0};
    parallel_for(context, cloud_.height(), kLinesPerPiece, [&](int64_t first, int64_t last, int64_t) {
      WindowList list;
      StragglerSearch search(cloud_, boxes, k_);
      Stragglers stragglers;
      for (int64_t v = first; v < last; ++v)
        for (int64_t u = 0; u < cloud_.width(); u += kQueries) {
          const int64_t at = v * cloud_.stride() + u;
          const QueryGroup queries(cloud_.x() + at, cloud_.y() + at, cloud_.z() + at);
          if (queries.active == 0) continue;
          const Place place(cloud_, queries, u, v);
          const PackMask proved = search_windows(queries, place, at, list);
          if (proved != 0) task_(list.squared(), proved, cloud_.rows(at));
          PackMask left = queries.active & ~proved;
          if (left == 0) continue;
          // The query itself is nearest, so that the k-1-th of the others is the k-th.
          const FloatPack bounds = list.bound();
          for (; left != 0; left &= left - 1) {
            const int lane = __builtin_ctz(left);
            const uint32_t row = cloud_.row(at + lane);
            const float bound = bounds[lane];
            if (work.load(std::memory_order_relaxed) > kWorkPerPoint * count) {
              rest[num_rest.fetch_add(1, std::memory_order_relaxed)] = {row, bound};
              continue;
            }
            const int64_t before = search.work();
            search.run(queries, lane, place.rectangle(lane, bound), v, bound);
            work.fetch_add(search.work() - before, std::memory_order_relaxed);
            stragglers.add(row, search, k_ - 1);
            if (stragglers.number == kQueries) finish(stragglers, list);
          }
        }
      if (stragglers.number != 0) finish(stragglers, list);
    });
    return num_rest.load();
  }

 private:
  static constexpr int64_t kLinesPerPiece = 4;
  static constexpr int kMoreRings = 8;
  static constexpr int kWorth = 2;             // lanes for which a further ring costs less than searches of their own
  static constexpr int64_t kWorkPerPoint = 4;  // registers of pixels looked at for stragglers, per point of the cloud

  static int first_reach(int k) {
    int reach = 1;
    while ((2 * reach + 1) * (2 * reach + 1) < k) ++reach;
    return reach;
  }

  void finish(Stragglers& stragglers, WindowList& list) const {
    for (int lane = 0; lane < stragglers.number; ++lane)
      for (int i = stragglers.length[lane]; i < stragglers.longest; ++i) stragglers.squared[i][lane] = kInfinity;
    list.start(k_ - 1);
    list.take(stragglers.longest, ~PackMask{0}, [&](int i) { return FloatPack::load(stragglers.squared[i]); });
    task_(list.squared(), (PackMask{1} << stragglers.number) - 1, stragglers.row);
    stragglers.number = stragglers.longest = 0;
  }

  PackMask search_windows(const QueryGroup& queries, const Place& place, int64_t at, WindowList& list) const {
    list.start(k_ - 1);
    int reach = first_reach(k_);
    take(queries, queries.active, at, rings_.begin(1), rings_.end(reach), list);
    for (;;) {
      const FloatPack bound = list.bound();
      const PackMask proved = less(bound, place.clear_within(reach)) & queries.active, open = queries.active & ~proved;
      if (open == 0 || reach == max_reach(k_)) return proved;
      const PackMask hopeful = less(bound, place.clear_within(max_reach(k_))) & open;
      const PackMask lost = open & ~less(bound, FloatPack(kInfinity));
      if (__builtin_popcount(hopeful) < kWorth && lost == 0) return proved;
      ++reach;
      take(queries, open, at, rings_.begin(reach), rings_.end(reach), list);
    }
  }

  void take(const QueryGroup& queries, PackMask lanes, int64_t at, const WindowRings::Offset* begin,
            const WindowRings::Offset* end, WindowList& list) const {
    const float *xs = cloud_.x() + at, *ys = cloud_.y() + at, *zs = cloud_.z() + at;
    const int64_t stride = cloud_.stride();
    const FloatPack x = queries.x, y = queries.y, z = queries.z;
    list.take(static_cast<int>(end - begin), lanes, [=](int i) __attribute__((always_inline)) {
      const int64_t other = begin[i].dv * stride + begin[i].du;
      return squared_length(FloatPack::load(xs + other) - x, FloatPack::load(ys + other) - y,
                            FloatPack::load(zs + other) - z);
    });
  }

  const OrganizedCloud& cloud_;
  int k_;
  const Task& task_;
  WindowRings rings_;
};

}  // namespace pc::neighbors
