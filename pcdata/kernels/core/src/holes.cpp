// Holes of depth images, filled from the readings beside them.
#include "pc/images/padded_rows.hpp"
#include "pc/memory.hpp"

namespace pc::holes {
namespace {

constexpr int64_t kPiece = int64_t{1} << 15;  // pixels that a thread takes at once

enum Rule : int64_t { kLeft = 0, kFarthest = 1, kNearest = 2 };

struct Images : images::Shape {
  int64_t rows() const { return views * height; }
  int64_t rows_at_once() const { return std::max<int64_t>(1, kPiece / std::max<int64_t>(width, 1)); }
};

// Where it says how far a pixel lies from the reading that it copies: the distance, or whether it is above a limit.
struct Told {
  int64_t* distance;  // may be null
  int64_t limit;
  uint8_t* far;  // may be null

  void clear(int64_t begin, int64_t end) const {
    if (distance != nullptr) std::fill(distance + begin, distance + end, 0);
    if (far != nullptr) std::fill(far + begin, far + end, 0);
  }
  void set(int64_t pixel, int64_t steps) const {
    if (distance != nullptr) distance[pixel] = steps;
    if (far != nullptr) far[pixel] = steps > limit;
  }
};

// -- which holes --------------------------------------------------------------------------------------------------

// Mark the pixels of one image over which a square of `side` pixels without a reading fits within the image.
void mark_wide(const float* depth, int64_t height, int64_t width, int64_t side, uint8_t* wide) {
  std::vector<int64_t> rows(static_cast<size_t>(width), 0);
  for (int64_t v = 0; v < height; ++v) {  // first the last corners of the squares
    int64_t run = 0;
    for (int64_t u = 0; u < width; ++u) {
      run = depth[v * width + u] > 0 ? 0 : run + 1;
      int64_t& empty = rows[static_cast<size_t>(u)];
      empty = run >= side ? empty + 1 : 0;
      wide[v * width + u] = empty >= side;
    }
  }
  std::fill(rows.begin(), rows.end(), 0);
  for (int64_t v = height - 1; v >= 0; --v) {
    int64_t columns = 0;
    for (int64_t u = width - 1; u >= 0; --u) {
      int64_t& left = rows[static_cast<size_t>(u)];
      left = wide[v * width + u] != 0 ? side : std::max<int64_t>(left - 1, 0);
      columns = left > 0 ? side : std::max<int64_t>(columns - 1, 0);
      wide[v * width + u] = columns > 0;
    }
  }
}

// Of all images, or null if every hole is to be filled.
const uint8_t* wide_holes(const pc_context& context, ScratchFrame& scratch, const float* depth, const Images& images,
                          int64_t max_size) {
  const int64_t side = max_size + 1, pixels = images.height * images.width;
  if (max_size <= 0 || side > images.height || side > images.width) return nullptr;
  uint8_t* wide = scratch.take<uint8_t>(images.views * pixels);
  parallel_for(context, images.views, 1, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t view = begin; view < end; ++view)
      mark_wide(depth + view * pixels, images.height, images.width, side, wide + view * pixels);
  });
  return wide;
}

// -- from the left ------------------------------------------------------------------------------------------------

void fill_from_left(const pc_context& context, const float* depth, const Images& images, const uint8_t* wide,
                    float* filled, const Told& told) {
  parallel_for(context, images.rows(), images.rows_at_once(), [&](int64_t begin, int64_t end, int64_t) {
    told.clear(begin * images.width, end * images.width);
    for (int64_t row = begin; row < end; ++row) {
      float last = 0;  // the reading that can be copied
      int64_t steps = 0;
      for (int64_t at = row * images.width; at < (row + 1) * images.width; ++at) {
        if (depth[at] > 0 || (wide != nullptr && wide[at] != 0)) {
          last = filled[at] = depth[at];
          steps = 0;
        } else {
          filled[at] = last;
          if (last > 0) told.set(at, ++steps);
        }
      }
    }
  });
}

// Up to `radius` pixels of every gap from the side where the row begins; step -1 = from its other end.
void fill_gaps(float* at, int64_t count, int64_t step, int64_t radius) {
  float last = 0;
  int64_t steps = 0;
  for (int64_t i = 0; i < count; ++i, at += step) {
    if (*at > 0) {
      last = *at;
      steps = 0;
    } else if (last > 0 && steps < radius) {
      *at = last;
      ++steps;
    } else {
      last = 0;
    }
  }
}

// -- inwards from the rims ----------------------------------------------------------------------------------------

// Layer after layer: the pixels of one take their depths from those before it, and then call up the next. The images
// have a border, and every pixel one number: its depth, or why it has none.
class Layers {
 public:
  Layers(const pc_context& context, ScratchFrame& scratch, const float* depth, const Images& images,
         const uint8_t* wide)
      : context_(context), images_(images), stride_(images.width + 2) {
    const int64_t padded = images.views * (images.height + 2) * stride_;
    values_ = scratch.take<float>(padded);
    queue_ = scratch.take<Place>(images.views * images.height * images.width + 4);
    chosen_ = scratch.take<float>(images.views * images.height * images.width);
    const int64_t rows = images.views * (images.height + 2);
    parallel_for(context, rows, images.rows_at_once(), [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t row = begin; row < end; ++row) {
        float* to = values_ + row * stride_;
        to[0] = to[stride_ - 1] = kNever;
        const int64_t view = row / (images.height + 2), v = row % (images.height + 2) - 1;
        const int64_t first = (view * images.height + v) * images.width;
        if (v < 0 || v == images.height)
          std::fill_n(to, stride_, kNever);
        else if (wide == nullptr)
          std::copy_n(depth + first, images.width, to + 1);
        else
          for (int64_t u = 0; u < images.width; ++u) to[u + 1] = wide[first + u] != 0 ? kNever : depth[first + u];
      }
    });
    find_first();
  }

  template <bool kFarthestOfFour>
  void fill() {
    Poll poll(context_);
    const auto stride = static_cast<int32_t>(stride_), width = static_cast<int32_t>(images_.width);
    const Place apart[4] = {{-width, -stride}, {-1, -1}, {1, 1}, {width, stride}};
    for (int64_t begin = 0, end = count_; begin < end; begin = end, end = count_) {
      poll.check();
      starts_.push_back(begin);
      for (int64_t i = begin; i < end; ++i) {
        const float* own = values_ + queue_[i].padded;
        const float a = own[-stride], b = own[-1], c = own[1], d = own[stride];
        chosen_[i] = kFarthestOfFour ? std::max(std::max(a, b), std::max(c, d))
                                     : std::min(std::min(near(a), near(b)), std::min(near(c), near(d)));
      }
      for (int64_t i = begin; i < end; ++i) {
        const Place place = queue_[i];
        values_[place.padded] = chosen_[i];
        for (const Place& step : apart) {  // without a branch that nobody foresees
          float& value = values_[place.padded + step.padded];
          queue_[count_] = {place.pixel + step.pixel, place.padded + step.padded};
          count_ += value == 0;
          value = value == 0 ? kCalled : value;
        }
      }
    }
    starts_.push_back(count_);
  }

  void write(float* filled, const Told& told) const {
    parallel_for(context_, images_.rows(), images_.rows_at_once(), [&](int64_t begin, int64_t end, int64_t) {
      told.clear(begin * images_.width, end * images_.width);
      for (int64_t row = begin; row < end; ++row) {
        const float* from = values_ + padded_row(row);
        float* to = filled + row * images_.width;
        for (int64_t u = 0; u < images_.width; ++u) to[u] = from[u] > 0 ? from[u] : 0.0f;
      }
    });
    for (size_t step = 1; step < starts_.size(); ++step)
      for (int64_t i = starts_[step - 1]; i < starts_[step]; ++i) told.set(queue_[i].pixel, static_cast<int64_t>(step));
  }

 private:
  // Holes that wait are 0, as they come. Not to be filled: the border, and wide holes; to be filled in the next layer.
  static constexpr float kNever = -1.0f, kCalled = -2.0f;

  struct Place {
    int32_t pixel, padded;
  };

  static float near(float value) { return value > 0 ? value : std::numeric_limits<float>::infinity(); }

  int64_t padded_row(int64_t row) const {
    return (row / images_.height * (images_.height + 2) + row % images_.height + 1) * stride_ + 1;
  }

  // The first layer: holes beside a reading.
  void find_first() {
    constexpr int64_t kBlock = 64;
    const int64_t at_once = images_.rows_at_once();
    std::vector<std::vector<Place>> found(static_cast<size_t>((images_.rows() + at_once - 1) / at_once));
    parallel_for(context_, images_.rows(), at_once, [&](int64_t begin, int64_t end, int64_t) {
      std::vector<Place>& mine = found[static_cast<size_t>(begin / at_once)];
      for (int64_t row = begin; row < end; ++row) {
        const int64_t start = padded_row(row), width = images_.width;
        for (int64_t block = 0; block < width; block += kBlock) {
          const int64_t end_of_block = std::min(block + kBlock, width);
          int32_t holes = 0;  // most blocks have none
          for (int64_t u = block; u < end_of_block; ++u) holes += values_[start + u] == 0;
          if (holes == 0) continue;
          for (int64_t u = block; u < end_of_block; ++u) {
            const float* own = values_ + start + u;
            if (*own != 0) continue;
            const bool beside = (own[-1] > 0) | (own[1] > 0) | (own[-stride_] > 0) | (own[stride_] > 0);
            if (beside) mine.push_back({static_cast<int32_t>(row * width + u), static_cast<int32_t>(start + u)});
          }
        }
      }
    });
    for (const auto& some : found) {
      std::copy(some.begin(), some.end(), queue_ + count_);
      count_ += static_cast<int64_t>(some.size());
    }
    for (int64_t i = 0; i < count_; ++i) values_[queue_[i].padded] = kCalled;
  }

  const pc_context& context_;
  const Images& images_;
  const int64_t stride_;
  float* values_;
  float* chosen_;
  Place* queue_;  // every pixel that is filled, in order,
  int64_t count_ = 0;
  std::vector<int64_t> starts_;  // layer by layer
};

void fill_inwards(const pc_context& context, ScratchFrame& scratch, const float* depth, const Images& images,
                  const uint8_t* wide, int64_t rule, float* filled, const Told& told) {
  Layers layers(context, scratch, depth, images, wide);
  if (rule == kFarthest)
    layers.fill<true>();
  else
    layers.fill<false>();
  layers.write(filled, told);
}

}  // namespace
}  // namespace pc::holes

PC_EXPORT int32_t pc_fill_holes(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                int64_t width, int64_t rule, int64_t max_size, float* filled, int64_t* distance,
                                int64_t limit, uint8_t* far) {
  using namespace pc;
  using namespace pc::holes;
  return guarded([&] {
    ScratchFrame scratch;
    const Images images{{views, height, width}};
    const Told told{distance, limit, far};
    if (views * height * width == 0) return;
    const uint8_t* wide = wide_holes(*context, scratch, depth, images, max_size);
    if (rule == kLeft)
      fill_from_left(*context, depth, images, wide, filled, told);
    else
      fill_inwards(*context, scratch, depth, images, wide, rule, filled, told);
  });
}

PC_EXPORT int32_t pc_fill_rows(const pc_context* context, const float* values, int64_t rows, int64_t width,
                               int64_t radius, float* filled) {
  using namespace pc;
  using namespace pc::holes;
  return guarded([&] {
    if (width == 0) return;
    const Images images{{1, rows, width}};
    parallel_for(*context, rows, images.rows_at_once(), [&](int64_t begin, int64_t end, int64_t) {
      std::copy(values + begin * width, values + end * width, filled + begin * width);
      for (int64_t row = begin; row < end; ++row) {
        fill_gaps(filled + row * width, width, 1, radius);
        fill_gaps(filled + (row + 1) * width - 1, width, -1, radius);
      }
    });
  });
}

PC_EXPORT int32_t pc_filled_confidence(const pc_context* context, const float* before, const float* after,
                                       int64_t count, const uint8_t* confidence, const uint8_t* far,
                                       uint8_t* filled_confidence, int64_t* any_filled) {
  using namespace pc;
  using namespace pc::holes;
  constexpr int32_t kFar = 1, kNear = 2, kRead = 3;
  constexpr int kSome = 256;
  return guarded([&] {
    std::atomic<bool> any{false};
    parallel_for(*context, count, kPiece, [&](int64_t begin, int64_t end, int64_t) {
      int32_t filled = 0;
      for (int64_t at = begin; at < end; at += kSome) {
        const auto some = static_cast<int>(std::min<int64_t>(kSome, end - at));
        int32_t was[kSome], guess[kSome];
        const float *old_depth = before + at, *new_depth = after + at;
        uint8_t* to = filled_confidence + at;  // not read again after each byte, which may lie anywhere
        for (int i = 0; i < some; ++i)
          was[i] = confidence != nullptr ? confidence[at + i] : old_depth[i] > 0 ? kRead : 0;
        for (int i = 0; i < some; ++i) guess[i] = far != nullptr && far[at + i] != 0 ? kFar : kNear;
        for (int i = 0; i < some; ++i) {
          const int32_t guessed = (old_depth[i] == 0) & (new_depth[i] > 0);
          was[i] = guessed != 0 ? guess[i] : was[i];
          filled |= guessed;
        }
        for (int i = 0; i < some; ++i) to[i] = static_cast<uint8_t>(was[i]);
      }
      if (filled != 0) any.store(true, std::memory_order_relaxed);
    });
    *any_filled = any.load() ? 1 : 0;
  });
}
