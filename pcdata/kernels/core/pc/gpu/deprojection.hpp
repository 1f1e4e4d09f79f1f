// Depth images to points: one pass chooses the pixels that become points, a second writes them where they belong, which
// the running total of those chosen says.
#pragma once

#include "pc/gpu/thread.hpp"
#include "pc/math/affine.hpp"

namespace pc::gpu {

// Depth images (views, height, width) and the directions in which their pixels look: x/z of every column (views, width)
// and y/z of every row (views, height), or both of every pixel (views, height, width, 2), each null for the other.
struct DepthImages {
  const float* depth;
  int64_t views, height, width;
  const float *column_rays, *row_rays, *rays;
  const double* matrices;  // (views, 4, 4) or null: what moves the points of a view

  PC_HD int64_t pixels() const { return views * height * width; }
  PC_HD int64_t view_of(int64_t pixel) const { return pixel / (height * width); }
  PC_HD bool has_ray(int64_t pixel) const { return rays == nullptr || rays[2 * pixel] == rays[2 * pixel]; }
  PC_HD math::Ray ray(int64_t pixel) const {
    if (rays != nullptr) return {rays[2 * pixel], rays[2 * pixel + 1]};
    const int64_t row = pixel / width;
    return {column_rays[row / height * width + (pixel - row * width)], row_rays[row]};
  }
  PC_HD math::Point point(int64_t pixel) const {
    const math::Ray along = ray(pixel);
    const float z = depth[pixel];
    const math::Point p{along.x * z, along.y * z, z};
    return matrices == nullptr ? p : math::Affine(matrices + 16 * view_of(pixel))(p);
  }
};

#define PC_DEPTH_IMAGES_PARAMETERS                                                                                   \
  const float *depth, int64_t views, int64_t height, int64_t width, const float *column_rays, const float *row_rays, \
      const float *rays, const double *matrices
#define PC_DEPTH_IMAGES \
  const DepthImages images { depth, views, height, width, column_rays, row_rays, rays, matrices }

constexpr int kWordsOfWarp = 8;  // each of 32 pixels

// How many pixels of a view were counted, told to all once the next view begins.
struct ViewCount {
  int64_t* told;  // (views)
  int64_t view = -1;
  int count = 0;

  PC_HD explicit ViewCount(int64_t* counts) : told(counts) {}
  PC_HD void tell() {
    if (count > 0 && lane() == 0) atomic_add(told + view, static_cast<int64_t>(count));
    count = 0;
  }
  // The marked pixels of a word, all of one view.
  PC_HD void add(int64_t of_view, uint32_t marked) {
    if (of_view != view) tell();
    view = of_view;
    count += count_bits(marked);
  }
};

// Choose the readings within [near, far] and a mask (or null), then, of their points, those in a box (if there is one).
// `kept` gets a bit for each of 32 pixels, `counts` their number; `told` (2 * views + 2) starts as 0: how many each
// view keeps, how many readings the box decided about, whether something is wrong (a depth or ray that cannot be), and
// whether a point is not finite.
PC_BLOCK_KERNEL(pc_choose_readings, PC_DEPTH_IMAGES_PARAMETERS, double near, double far, const uint8_t* mask,
                int64_t has_box, double low_x, double low_y, double low_z, double high_x, double high_y, double high_z,
                uint32_t* kept, int64_t* counts, int64_t* told) {
  PC_DEPTH_IMAGES;
  const math::CropBox box{{static_cast<float>(low_x), static_cast<float>(low_y), static_cast<float>(low_z)},
                          {static_cast<float>(high_x), static_cast<float>(high_y), static_cast<float>(high_z)}};
  const float nearest = static_cast<float>(near), farthest = static_cast<float>(far);
  const int64_t pixels = images.pixels(), words = (pixels + PC_WARP - 1) / PC_WARP;
  const int64_t first = thread_index() / PC_WARP * kWordsOfWarp;
  ViewCount of_kept(told), of_readings(told + views);
  for (int64_t word = first; word < first + kWordsOfWarp && word < words; ++word) {
    const int64_t pixel = word * PC_WARP + lane();
    bool is_reading = false, is_kept = false;
    if (pixel < pixels) {
      const float z = depth[pixel];
      is_reading = z > 0 && z >= nearest && z <= farthest && (mask == nullptr || mask[pixel] != 0);
      if (!(z >= 0) || (is_reading && !images.has_ray(pixel))) told[2 * views] = 1;
      if (is_reading) {
        const math::Point p = images.point(pixel);
        if (!math::is_finite(p)) told[2 * views + 1] = 1;
        is_kept = has_box == 0 || box.contains(p);
      }
    }
    const uint32_t all_kept = ballot(is_kept), all_readings = ballot(is_reading);
    if (lane() == 0) {
      kept[word] = all_kept;
      counts[word] = count_bits(all_kept);
    }
    const int64_t end = (word + 1) * PC_WARP < pixels ? (word + 1) * PC_WARP : pixels;
    const int64_t view = images.view_of(word * PC_WARP);
    if (view == images.view_of(end - 1)) {
      of_kept.add(view, all_kept);
      of_readings.add(view, all_readings);
    } else {
      if (is_kept) atomic_add(told + images.view_of(pixel), int64_t{1});
      if (is_reading) atomic_add(told + views + images.view_of(pixel), int64_t{1});
    }
  }
  of_kept.tell();
  of_readings.tell();
}

// Write the points that were chosen, with their pixels, numbered over all views or within their own, and, from RGB
// images (views, height, width, 3), their colors (M, 3) in [0, 1], each or null; `ends` is the running total of counts.
PC_KERNEL(pc_write_points, PC_DEPTH_IMAGES_PARAMETERS, const uint32_t* kept, const int64_t* ends,
          int64_t over_all_views, const uint8_t* rgb, float* points, int64_t* pixel_index, float* colors) {
  const int64_t pixel = thread_index();
  PC_DEPTH_IMAGES;
  if (pixel >= images.pixels()) return;
  const uint32_t bits = kept[pixel / PC_WARP], own = uint32_t{1} << (pixel % PC_WARP);
  if ((bits & own) == 0) return;
  const int64_t row = ends[pixel / PC_WARP] - count_bits(bits & ~(own - 1));
  const math::Point p = images.point(pixel);
  points[3 * row] = p.x;
  points[3 * row + 1] = p.y;
  points[3 * row + 2] = p.z;
  pixel_index[row] = over_all_views != 0 ? pixel : pixel % (height * width);
  if (rgb == nullptr) return;
  for (int i = 0; i < 3; ++i) colors[3 * row + i] = static_cast<float>(rgb[3 * pixel + i]) / 255.0F;
}

// Depth within [near, far] and a mask (or null), 0 elsewhere.
PC_KERNEL(pc_keep_depths, const float* depth, int64_t count, double near, double far, const uint8_t* mask,
          float* masked) {
  const int64_t i = thread_index();
  if (i >= count) return;
  const float z = depth[i];
  const bool is_kept =
      z > 0 && z >= static_cast<float>(near) && z <= static_cast<float>(far) && (mask == nullptr || mask[i] != 0);
  masked[i] = is_kept ? z : 0.0F;
}

}  // namespace pc::gpu
