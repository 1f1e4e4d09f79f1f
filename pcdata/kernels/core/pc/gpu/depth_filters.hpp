// Depth images filtered pixel by pixel: along lines, over time, within windows; what flies goes.
#pragma once

#include "pc/gpu/thread.hpp"
#include "pc/math/depth.hpp"

namespace pc::gpu {

// A pixel with those around it, as if there were pixels without a reading beyond the image.
struct PixelAround {
  const float* image;  // of its view
  int64_t height, width, row, column;

  PC_HD PixelAround(const float* depth, int64_t rows, int64_t columns, int64_t pixel)
      : image(depth + pixel / (rows * columns) * (rows * columns)),
        height(rows),
        width(columns),
        row(pixel / columns % rows),
        column(pixel % columns) {}
  PC_HD float at(int64_t down, int64_t across) const {
    const int64_t v = row + down, u = column + across;
    return v >= 0 && v < height && u >= 0 && u < width ? image[v * width + u] : 0.0F;
  }
  PC_HD float own() const { return image[row * width + column]; }
};

// scale / value of images of `pixels` each with a scale each, or the values; `none` where there is no reading.
PC_KERNEL(pc_read_values, const float* values, int64_t count, const float* scales, int64_t pixels, double none,
          float* read) {
  const int64_t i = thread_index();
  if (i >= count) return;
  const float value = values[i], missing = static_cast<float>(none);
  read[i] = scales != nullptr ? math::reciprocal(value, scales[i / pixels], missing) : value > 0 ? value : missing;
}

constexpr int kAhead = 16;  // values of a line that are on their way while others are averaged

// Average along a line of `count` values `step` apart, in place.
PC_HD void average_line(float* at, int64_t count, int64_t step, float keep, float delta) {
  math::LineAverage average{at[0], at[0]};
  float ahead[kAhead];
  for (int64_t first = 1; first < count; first += kAhead) {
    for (int i = 0; i < kAhead; ++i) ahead[i] = first + i < count ? at[(first + i) * step] : 0.0F;
    for (int i = 0; i < kAhead; ++i) {
      const float mean = average.next(ahead[i], keep, delta);
      if (first + i < count) at[(first + i) * step] = mean;
    }
  }
}

// Average along lines, forth and back, in place: values (count, lines), a thread for each line.
PC_KERNEL(pc_average_lines, float* values, int64_t count, int64_t lines, double keep, double delta) {
  const int64_t line = thread_index();
  if (line >= lines) return;
  const float share = static_cast<float>(keep), edge = static_cast<float>(delta);
  average_line(values + line, count, lines, share, edge);
  average_line(values + (count - 1) * lines + line, count, -lines, share, edge);
}

// Average every pixel with its past; `scales` (views,) or null, as pc_read_values has them.
PC_KERNEL(pc_average_over_time, const float* values, int64_t count, const float* scales, int64_t pixels, double keep,
          double delta, int64_t needed, int64_t frames, const float* last, const uint8_t* history, float* filtered,
          float* new_last, uint8_t* new_history) {
  const int64_t i = thread_index();
  if (i >= count) return;
  const float scale = scales != nullptr ? scales[i / pixels] : 0.0F;
  const float now = scales != nullptr ? math::reciprocal(values[i], scale, 0.0F) : values[i];
  const math::OverTime found = math::OverTime::step(now, last[i], history[i], static_cast<float>(keep),
                                                    static_cast<float>(delta), needed, frames);
  filtered[i] = scales != nullptr ? math::reciprocal(found.filtered, scale, 0.0F) : found.filtered;
  new_last[i] = found.last;
  new_history[i] = static_cast<uint8_t>(found.history);
}

// Whether a reading lies beside an edge and shares a surface with fewer than `least` of its neighbors.
PC_HD bool flies(const PixelAround& pixel, float tolerance, int64_t least) {
  const float own = pixel.own();
  int on_surface = 0, around = 0;
  for (int down = -1; down <= 1; ++down)
    for (int across = -1; across <= 1; ++across) {
      const float other = pixel.at(down, across);
      if (down == 0 && across == 0) continue;
      around += math::lower(own, other) > 0;
      on_surface += math::on_one_surface(own, other, tolerance);
    }
  return on_surface != around && on_surface < least;
}

PC_KERNEL(pc_mark_flying, const float* depth, int64_t views, int64_t height, int64_t width, double tolerance,
          int64_t least, uint8_t* flying) {
  const int64_t i = thread_index();
  if (i >= views * height * width) return;
  flying[i] = flies(PixelAround(depth, height, width, i), static_cast<float>(tolerance), least);
}

// Depth without what flies, and its confidence (or null).
PC_KERNEL(pc_drop_flying, const float* depth, int64_t views, int64_t height, int64_t width, double tolerance,
          int64_t least, const uint8_t* confidence, float* kept, uint8_t* marks) {
  const int64_t i = thread_index();
  if (i >= views * height * width) return;
  const bool goes = flies(PixelAround(depth, height, width, i), static_cast<float>(tolerance), least);
  kept[i] = goes ? 0.0F : depth[i];
  if (confidence != nullptr) marks[i] = goes ? 0 : confidence[i];
}

// Means of the readings of a window on the pixel's own surface, by `shares` (window, window) and nearness in depth.
PC_KERNEL(pc_average_windows, const float* depth, int64_t views, int64_t height, int64_t width, int64_t reach,
          const float* shares, double scale, double max_jump, float* smoothed) {
  const int64_t i = thread_index();
  if (i >= views * height * width) return;
  const PixelAround pixel(depth, height, width, i);
  const float own = pixel.own(), rate = static_cast<float>(scale), jump = static_cast<float>(max_jump);
  float total = 0, weight = 0;
  for (int64_t down = -reach; down <= reach; ++down)
    for (int64_t across = -reach; across <= reach; ++across, ++shares) {
      const float other = pixel.at(down, across);
      if (!math::on_one_surface(own, other, jump)) continue;
      const float offset = other - own, scaled = offset * rate;
      const float share = math::power_of_two(-(scaled * scaled)) * *shares;
      total += share * offset;
      weight += share;
    }
  smoothed[i] = own > 0 ? own + total / weight : 0.0F;
}

// The lower median of the readings of a window, with `max_jump` not below 0 of those on the pixel's own surface.
PC_KERNEL(pc_find_medians, const float* depth, int64_t views, int64_t height, int64_t width, int64_t reach,
          double max_jump, float* medians) {
  const int64_t i = thread_index();
  if (i >= views * height * width) return;
  const PixelAround pixel(depth, height, width, i);
  const float own = pixel.own(), jump = static_cast<float>(max_jump);
  const auto counts = [&](float other) { return jump < 0 ? other > 0 : math::on_one_surface(own, other, jump); };
  medians[i] = 0;
  if (!(own > 0)) return;
  int64_t count = 0;
  for (int64_t down = -reach; down <= reach; ++down)
    for (int64_t across = -reach; across <= reach; ++across) count += counts(pixel.at(down, across));
  const int64_t wanted = (count - 1) / 2;
  for (int64_t down = -reach; down <= reach; ++down)
    for (int64_t across = -reach; across <= reach; ++across) {
      const float value = pixel.at(down, across);
      if (!counts(value)) continue;
      int64_t nearer = 0, equal = 0;
      for (int64_t v = -reach; v <= reach; ++v)
        for (int64_t u = -reach; u <= reach; ++u) {
          const float other = pixel.at(v, u);
          nearer += counts(other) && other < value;
          equal += counts(other) && other == value;
        }
      if (nearer <= wanted && wanted < nearer + equal) {
        medians[i] = value;
        return;
      }
    }
}

}  // namespace pc::gpu
