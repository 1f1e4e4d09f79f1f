// The boxes of an image's tiles, and the search of them for one query: for the few that windows leave without a proof.
#pragma once

#include <algorithm>

#include "pc/neighbors/window_proof.hpp"

namespace pc::neighbors {

// The boxes of tiles of 16 x 8 pixels, sixteen tiles of a row side by side; an empty tile's is at infinity.
class ImageBoxes {
 public:
  static constexpr int64_t kColumns = kQueries, kLines = 8;

  ImageBoxes(const pc_context& context, ScratchFrame& scratch, const OrganizedCloud& cloud) {
    const int64_t across = (cloud.width() + kColumns - 1) / kColumns, down = (cloud.height() + kLines - 1) / kLines;
    groups_ = (across + kFanOut - 1) / kFanOut;
    boxes_ = scratch.take<Boxes>(groups_ * down);
    parallel_for(context, down, 1, [&](int64_t line, int64_t, int64_t) {
      for (int64_t tile = 0; tile < groups_ * kFanOut; ++tile) {
        float low[3] = {kInfinity, kInfinity, kInfinity}, high[3] = {-kInfinity, -kInfinity, -kInfinity};
        if (tile < across) measure(cloud, tile * kColumns, line * kLines, low, high);
        set_box(boxes_[line * groups_ + tile / kFanOut], tile % kFanOut, low, high);
      }
    });
  }

  // The boxes of the tiles 16 * group to 16 * group + 15 of a line of tiles.
  const Boxes& at(int64_t line, int64_t group) const { return boxes_[line * groups_ + group]; }

 private:
  static void measure(const OrganizedCloud& cloud, int64_t u, int64_t v, float (&low)[3], float (&high)[3]) {
    const int64_t end = std::min(v + kLines, cloud.height());
    const float* const axes[3] = {cloud.x(), cloud.y(), cloud.z()};
    for (int axis = 0; axis < 3; ++axis) {
      FloatPack least(kInfinity), most(-kInfinity);
      for (int64_t line = v; line < end; ++line) {
        const float* from = axes[axis] + line * cloud.stride() + u;
        // Missing pixels are at infinity on every axis.
        const FloatPack value = FloatPack::load(from);
        least = minimum(value, least);
        most = maximum(FloatPack::each([&](size_t p) {
                         const FloatRegister none = FloatRegister{} + kInfinity, some = value.part[p];
                         return select(pc::less(some, none), some, FloatRegister{} - none);
                       }),
                       most);
      }
      low[axis] = smallest(least);
      high[axis] = largest(most);
    }
  }

  int64_t groups_ = 0;
  Boxes* boxes_ = nullptr;
};

// Finds the squared distances that are less than a bound, to one query after another.
class StragglerSearch {
 public:
  StragglerSearch(const OrganizedCloud& cloud, const ImageBoxes& boxes, int wanted)
      : cloud_(cloud), boxes_(boxes), wanted_(wanted) {}

  // As many as are found at most.
  static constexpr int kMost = 96;

  // Search a rectangle that is known to hold all points within `bound`: the k-th squared distance of some candidates,
  // or infinity. Where more than kMost are nearer, the bound falls so that at least the k nearest are left.
  void run(const QueryGroup& queries, int lane, const Place::Rectangle& area, int64_t v, float bound) {
    at_[0] = queries.x[lane], at_[1] = queries.y[lane], at_[2] = queries.z[lane];
    bound_ = bound;
    count_ = 0;
    const int64_t own = v / ImageBoxes::kLines, first = area.above / ImageBoxes::kLines,
                  last = area.below / ImageBoxes::kLines;
    for (int64_t away = 0; away <= std::max(own - first, last - own); ++away) {
      if (own + away <= last) search_line(area, own + away);
      if (away != 0 && own - away >= first) search_line(area, own - away);
    }
  }

  int count() const { return count_; }
  const float* squared() const { return found_; }
  float bound() const { return bound_; }
  // Registers of pixels looked at so far.
  int64_t work() const { return work_; }

 private:
  static constexpr int kPasses = 12;
  static constexpr int kTile = static_cast<int>(ImageBoxes::kColumns * ImageBoxes::kLines);

  void search_line(const Place::Rectangle& area, int64_t line) {
    const int64_t left = area.left / ImageBoxes::kColumns, right = area.right / ImageBoxes::kColumns;
    for (int64_t group = left / kFanOut; group <= right / kFanOut; ++group) {
      const Boxes& boxes = boxes_.at(line, group);
      FloatPack gap[3];
      for (int axis = 0; axis < 3; ++axis)
        gap[axis] = maximum(maximum(FloatPack::load(boxes.low[axis]) - FloatPack(at_[axis]),
                                    FloatPack(at_[axis]) - FloatPack::load(boxes.high[axis])),
                            FloatPack(0.0f));
      const FloatPack gaps = squared_length(gap[0], gap[1], gap[2]);
      PackMask near = less(gaps, FloatPack(bound_));
      if (group == left / kFanOut) near &= ~PackMask{0} << left % kFanOut;
      if (group == right / kFanOut) near &= (PackMask{2} << right % kFanOut) - 1;
      for (; near != 0; near &= near - 1) {
        const int tile = __builtin_ctz(near);
        if (!(gaps[tile] < bound_)) continue;
        search_tile((group * kFanOut + tile) * ImageBoxes::kColumns, std::max(area.above, line * ImageBoxes::kLines),
                    std::min(area.below, line * ImageBoxes::kLines + ImageBoxes::kLines - 1));
        // Without a bound all of the image would be looked at.
        if (count_ > (bound_ < kInfinity ? kMost : wanted_)) shrink();
      }
    }
  }

  void search_tile(int64_t u, int64_t above, int64_t below) {
    const FloatPack x(at_[0]), y(at_[1]), z(at_[2]), bound(bound_);
    const int64_t stride = cloud_.stride();
    const float *xs = cloud_.x() + u, *ys = cloud_.y() + u, *zs = cloud_.z() + u;
    float* next = found_ + count_;
    for (int64_t v = above; v <= below; ++v) {
      const FloatPack squared =
          squared_length(FloatPack::load(xs + v * stride) - x, FloatPack::load(ys + v * stride) - y,
                         FloatPack::load(zs + v * stride) - z);
      for (int p = 0; p < FloatPack::kParts; ++p)
        next += store_chosen(next, squared.part[p], pc::less(squared.part[p], bound.part[p]));
    }
    count_ = static_cast<int>(next - found_);
    work_ += below - above + 1;
  }

  // Lower the bound to one below which there are enough, but not many more, and keep those.
  void shrink() {
    const int whole = (count_ + kQueries - 1) / kQueries * kQueries;
    std::fill(found_ + count_, found_ + whole, kInfinity);
    float low = 0, high = *std::max_element(found_, found_ + count_);
    // Of distances on a surface, about as many are below a bound as the area within it.
    float middle = high * std::min(0.9f, 1.5f * static_cast<float>(wanted_) / static_cast<float>(count_));
    for (int pass = 0; pass < kPasses; ++pass, middle = low + (high - low) / 2) {
      const int below = count_below(middle, whole);
      if (below >= wanted_ && below <= kMost / 2) return keep_below(middle, whole);
      (below < wanted_ ? low : high) = middle;
    }
    std::nth_element(found_, found_ + wanted_ - 1, found_ + count_);
    bound_ = found_[wanted_ - 1];
    count_ = static_cast<int>(std::partition(found_, found_ + wanted_, [&](float d) { return d < bound_; }) - found_);
  }
  int count_below(float bound, int whole) const {
    int count = 0;
    for (int i = 0; i < whole; i += kQueries)
      count += __builtin_popcount(less(FloatPack::load(found_ + i), FloatPack(bound)));
    return count;
  }
  void keep_below(float bound, int whole) {
    const FloatRegister below = FloatRegister{} + bound;
    float* next = found_;
    for (int i = 0; i < whole; i += kLanes) {
      const FloatRegister some = load<FloatRegister>(found_ + i);
      next += store_chosen(next, some, pc::less(some, below));
    }
    bound_ = bound;
    count_ = static_cast<int>(next - found_);
  }

  const OrganizedCloud& cloud_;
  const ImageBoxes& boxes_;
  int wanted_, count_ = 0;
  int64_t work_ = 0;
  float at_[3] = {}, bound_ = 0;
  float found_[kMost + kTile + kQueries];
};

}  // namespace pc::neighbors
