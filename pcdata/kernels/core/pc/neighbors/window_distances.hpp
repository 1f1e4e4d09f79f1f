// The distances to the nearest points of a cloud on a depth image, sixteen pixels at a time.
#pragma once

#include "pc/neighbors/batch_search.hpp"
#include "pc/neighbors/image_boxes.hpp"
#include "pc/neighbors/window_list.hpp"

namespace pc::neighbors {

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

// The squared distances from sixteen queries to the pixels around them.
struct AroundPixel {
  const float *x, *y, *z;  // of the first query's pixel
  FloatPack own[3];
  const int64_t* offset;  // of the pixels around it

  [[gnu::always_inline]] FloatRegister operator()(int i, int lane) const {
    const int64_t at = offset[i] + lane;
    const size_t part = static_cast<size_t>(lane / kLanes);
    return squared_length(own[0].part[part] - load<FloatRegister>(x + at),
                          own[1].part[part] - load<FloatRegister>(y + at),
                          own[2].part[part] - load<FloatRegister>(z + at));
  }
};

// Calls for every query of the cloud, in no order, task(list, lanes, row) with the list of squared distances to its
// nearest others, infinity where there are fewer than k - 1. Those that would take too much work it returns.
template <class Task>
class WindowDistances {
 public:
  // The half-width that windows have at most.
  static int max_reach(int k) { return first_reach(k) + kMoreRings; }

  WindowDistances(const OrganizedCloud& cloud, int k, const Task& task) : cloud_(cloud), k_(k), task_(task) {
    const WindowRings rings(max_reach(k));
    for (int ring = 1; ring <= max_reach(k); ++ring) {
      for (auto pixel = rings.begin(ring); pixel != rings.end(ring); ++pixel)
        offset_.push_back(pixel->dv * cloud.stride() + pixel->du);
    }
  }

  int64_t run(const pc_context& context, ScratchFrame& scratch, int64_t count, Unproved* rest) {
    const auto in_blocks = [&](auto blocks) {
      return run_blocks<decltype(blocks)::value>(context, scratch, count, rest);
    };
    switch ((k_ - 1 + kBlockRows - 1) / kBlockRows) {
      case 1:
        return in_blocks(std::integral_constant<int, 1>());
      case 2:
        return in_blocks(std::integral_constant<int, 2>());
      case 3:
        return in_blocks(std::integral_constant<int, 3>());
      case 4:
        return in_blocks(std::integral_constant<int, 4>());
      case 5:
        return in_blocks(std::integral_constant<int, 5>());
      default:
        return in_blocks(std::integral_constant<int, kMostBlocks>());
    }
  }

 private:
  static constexpr int64_t kLinesPerPiece = 4;
  static constexpr int kMoreRings = 8;
  static constexpr int64_t kWorkPerPoint = 4;  // registers of pixels looked at for stragglers, per point of the cloud

  // A window of (2 reach + 1)^2 pixels with at least k in it.
  static int first_reach(int k) {
    int reach = 1;
    while (pixels_around(reach) + 1 < k) ++reach;
    return reach;
  }
  static int pixels_around(int reach) { return 4 * reach * (reach + 1); }

  template <int kBlocks>
  int64_t run_blocks(const pc_context& context, ScratchFrame& scratch, int64_t count, Unproved* rest) const {
    const ImageBoxes boxes(context, scratch, cloud_);
    std::atomic<int64_t> num_rest{0}, work{0};
    parallel_for(context, cloud_.height(), kLinesPerPiece, [&](int64_t first, int64_t last, int64_t) {
      WindowList<kBlocks> list(k_ - 1);
      StragglerSearch search(cloud_, boxes, k_);
      Stragglers stragglers;
      for (int64_t v = first; v < last; ++v)
        for (int64_t u = 0; u < cloud_.width(); u += kQueries) {
          const int64_t at = v * cloud_.stride() + u;
          const QueryGroup queries(cloud_.x() + at, cloud_.y() + at, cloud_.z() + at);
          if (queries.active == 0) continue;
          const Place place(cloud_, queries, u, v);
          const PackMask proved = search_windows(queries, place, at, list);
          if (proved != 0) task_(list, proved, cloud_.rows(at));
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

  template <class List>
  void finish(Stragglers& stragglers, List& list) const {
    const int longest = std::max((stragglers.longest + kBlockRows - 1) / kBlockRows * kBlockRows, List::kSize);
    for (int lane = 0; lane < stragglers.number; ++lane)
      for (int i = stragglers.length[lane]; i < longest; ++i) stragglers.squared[i][lane] = kInfinity;
    const auto squared = [&](int i, int lane) __attribute__((always_inline)) {
      return load<FloatRegister>(stragglers.squared[i] + lane);
    };
    list.start(squared);
    list.take(List::kSize, longest, squared);
    task_(list, (PackMask{1} << stragglers.number) - 1, stragglers.row);
    stragglers.number = stragglers.longest = 0;
  }

  template <class List>
  PackMask search_windows(const QueryGroup& queries, const Place& place, int64_t at, List& list) const {
    const AroundPixel around{
        cloud_.x() + at, cloud_.y() + at, cloud_.z() + at, {queries.x, queries.y, queries.z}, offset_.data()};
    int reach = first_reach(k_);
    list.start(around);
    if (pixels_around(reach) > List::kSize) list.take(List::kSize, pixels_around(reach), around);
    const FloatPack farthest = place.clear_within(max_reach(k_));
    for (;;) {
      const FloatPack bound = list.bound();
      const PackMask proved = less(bound, place.clear_within(reach)) & queries.active, open = queries.active & ~proved;
      if (open == 0 || reach == max_reach(k_)) return proved;
      // Even for one lane that can be proved a further ring costs less than a search of its own.
      const PackMask hopeful = less(bound, farthest) & open, lost = open & ~less(bound, FloatPack(kInfinity));
      if ((hopeful | lost) == 0) return proved;
      // Of the second ring most pixels are near to some lane, of those after it few.
      if (reach == first_reach(k_))
        list.take(pixels_around(reach), pixels_around(reach + 1), around);
      else
        list.take_few(pixels_around(reach), pixels_around(reach + 1), around);
      ++reach;
    }
  }

  const OrganizedCloud& cloud_;
  int k_;
  const Task& task_;
  std::vector<int64_t> offset_;  // of the pixels around one, nearest rings first
};

}  // namespace pc::neighbors
