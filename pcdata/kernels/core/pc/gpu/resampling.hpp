// Depth images of another size: blocks of pixels that become one, and pixels taken or interpolated at new centers.
#pragma once

#include "pc/gpu/thread.hpp"
#include "pc/math/depth.hpp"

namespace pc::gpu {

// The readings of a block of factor x factor pixels, which are numbered row by row.
struct DepthBlock {
  const float* first;  // the pixel in its upper left corner
  int64_t width;       // of the image
  int factor;

  PC_HD int places() const { return factor * factor; }
  PC_HD float at(int place) const { return first[place / factor * width + place % factor]; }
  PC_HD bool precedes(int a, float of_a, int b, float of_b) const { return of_a < of_b || (of_a == of_b && a < b); }
  // How many readings are nearer than one, or as near and numbered before.
  PC_HD int rank(int place) const {
    const float own = at(place);
    int rank = 0;
    for (int other = 0; other < places(); ++other) {
      const float value = at(other);
      rank += value > 0 && precedes(other, value, place, own);
    }
    return rank;
  }
};

// Make one pixel of every block, by the median of its readings (`mean` 0) or their mean.
PC_KERNEL(pc_decimate_depth, const float* depth, int64_t views, int64_t height, int64_t width, int64_t factor,
          int64_t mean, double max_jump, float* reduced, int64_t* pixel_index) {
  const int64_t i = thread_index(), rows = height / factor, columns = width / factor;
  if (i >= views * rows * columns) return;
  const int64_t column = i % columns * factor, row = i / columns % rows * factor, view = i / columns / rows;
  const DepthBlock block{depth + (view * height + row) * width + column, width, static_cast<int>(factor)};
  int count = 0;
  double total = 0;
  for (int place = 0; place < block.places(); ++place) {
    const float z = block.at(place);
    count += z > 0;
    total += static_cast<double>(z);
  }
  int middle = block.factor / 2 * block.factor + block.factor / 2;
  float low = 0, high = 0;
  for (int place = 0; place < block.places(); ++place) {
    const float z = block.at(place);
    if (!(z > 0)) continue;
    const int rank = block.rank(place);
    if (rank == (count - 1) / 2) {
      middle = place;
      low = z;
    }
    if (rank == count / 2) high = z;
  }
  if (count == 1 || count % 2 == 1) high = low;
  float found = high - low <= static_cast<float>(max_jump) * low ? low + 0.5F * (high - low) : low;
  if (mean != 0) found = static_cast<float>(total / static_cast<double>(count > 0 ? count : 1));
  reduced[i] = count > 0 ? found : 0.0F;
  pixel_index[i] = (row + middle / block.factor) * width + column + middle % block.factor;
}

// One axis of an image that is resized: `count` old pixels, and the way from one new center to the next.
struct Axis {
  int64_t count;
  double step;

  PC_HD double center(int64_t i) const { return (static_cast<double>(i) + 0.5) * step - 0.5; }
  PC_HD int64_t nearest(int64_t i) const { return within(static_cast<int64_t>(floor(center(i) + 0.5))); }
  // The old pixels on both sides of a new center, and how far it is from the first to the second.
  struct Between {
    int64_t first, second;
    float part;
  };
  PC_HD Between between(int64_t i) const {
    const double last = static_cast<double>(count - 1), at = center(i);
    const double inside = at < 0 ? 0 : at > last ? last : at;
    const auto first = static_cast<int64_t>(floor(inside));
    return {first, within(first + 1), static_cast<float>(inside - static_cast<double>(first))};
  }

 private:
  PC_HD int64_t within(int64_t at) const { return at < 0 ? 0 : at < count ? at : count - 1; }
};

// Take the nearest pixel at every new center; `max_jump` below 0: nothing else.
PC_KERNEL(pc_resize_depth, const float* depth, int64_t views, int64_t height, int64_t width, int64_t new_height,
          int64_t new_width, double step_down, double step_across, double max_jump, float* resized,
          int64_t* pixel_index) {
  const int64_t i = thread_index();
  if (i >= views * new_height * new_width) return;
  const int64_t column = i % new_width, row = i / new_width % new_height, view = i / new_width / new_height;
  const Axis down{height, step_down}, across{width, step_across};
  const float* image = depth + view * height * width;
  const int64_t nearest = down.nearest(row) * width + across.nearest(column);
  float found = image[nearest];
  if (max_jump >= 0) {
    const Axis::Between v = down.between(row), u = across.between(column);
    const float *above = image + v.first * width, *below = image + v.second * width;
    const float a = above[u.first], b = above[u.second], c = below[u.first], d = below[u.second];
    if (math::on_one_surface(a, b, c, d, static_cast<float>(max_jump))) {
      const float top = math::mixed(1 / a, 1 / b, u.part), bottom = math::mixed(1 / c, 1 / d, u.part);
      found = 1 / math::mixed(top, bottom, v.part);
    }
  }
  resized[i] = found;
  pixel_index[i] = nearest;
}

}  // namespace pc::gpu
