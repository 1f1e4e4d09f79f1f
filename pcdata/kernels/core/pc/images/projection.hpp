// Rows of depth pixels projected into a color camera. The float32 operations are the reference's, in its order.
#pragma once

#include <cmath>
#include <cstdint>

#include "pc/math/lens.hpp"

namespace pc::images {

// Beyond it sums of coordinates could overflow, and what infinities become is the reference's to say.
constexpr float kFarthest = 1e30F;

// One view's depth image (height, width) and both cameras.
struct DepthView {
  const float* depth;
  int64_t height, width;
  const float* column_rays = nullptr;  // x/z of every column (width,) and
  const float* row_rays = nullptr;     // y/z of every row (height,); or null, and then
  const float* rays = nullptr;         // both of every pixel (height, width, 2)
  float move[12] = {};                 // the upper rows of color_from_depth
  float fx = 0, skew = 0, cx = 0, fy = 0, cy = 0;
  float half_width = 0, half_height = 0;  // of a pixel's box, in color pixels, at equal depths
  const math::Lens* lens = nullptr;       // of the color camera, if it has one

  DepthView(const float* image, int64_t rows, int64_t columns) : depth(image), height(rows), width(columns) {}

  // color_from_depth (4, 4), color_intrinsics (3, 3), half_pixel (2,)
  void set_cameras(const double* color_from_depth, const double* color_intrinsics, const double* half_pixel) {
    for (int i = 0; i < 12; ++i) move[i] = static_cast<float>(color_from_depth[i]);
    fx = static_cast<float>(color_intrinsics[0]);
    skew = static_cast<float>(color_intrinsics[1]);
    cx = static_cast<float>(color_intrinsics[2]);
    fy = static_cast<float>(color_intrinsics[4]);
    cy = static_cast<float>(color_intrinsics[5]);
    half_width = static_cast<float>(half_pixel[0]);
    half_height = static_cast<float>(half_pixel[1]);
  }
};

// A row of depth pixels in the color camera; each (width,).
struct ProjectedRow {
  float *u, *v;
  float* z;        // along the color camera's axis
  float* reading;  // the depth, 0 where the pixel has none or the color camera cannot see it
  float *half_width, *half_height;

  static constexpr int64_t kArrays = 6;
  ProjectedRow(float* room, int64_t width)
      : u(room),
        v(room + width),
        z(room + 2 * width),
        reading(room + 3 * width),
        half_width(room + 4 * width),
        half_height(room + 5 * width) {}
};

struct PinholeRays {
  const float* columns;
  float row;
  float x(int64_t i) const { return columns[i]; }
  float y(int64_t) const { return row; }
};

struct PixelRays {
  const float* pixels;
  float x(int64_t i) const { return pixels[2 * i]; }
  float y(int64_t i) const { return pixels[2 * i + 1]; }
};

// The three steps from a row of depths to color pixels. Plain loops over arguments and local values: they vectorize.

// Move the readings into the color camera: x/z, y/z and z there. Returns how many have no ray.
template <class Ray>
int32_t move_row(const DepthView& view, const float* __restrict depth, const Ray ray, int64_t width,
                 float* __restrict x, float* __restrict y, float* __restrict z, float* __restrict reading) {
  const float a0 = view.move[0], b0 = view.move[1], c0 = view.move[2], d0 = view.move[3];
  const float a1 = view.move[4], b1 = view.move[5], c1 = view.move[6], d1 = view.move[7];
  const float a2 = view.move[8], b2 = view.move[9], c2 = view.move[10], d2 = view.move[11];
  int32_t lost = 0;
  for (int64_t i = 0; i < width; ++i) {
    const float ray_x = ray.x(i), ray_y = ray.y(i), d = depth[i];
    const float moved_z = ((a2 * ray_x + b2 * ray_y) + c2) * d + d2;
    const bool visible = (d > 0) & (moved_z > 0);
    const float divisor = visible ? moved_z : 1.0F;
    x[i] = (((a0 * ray_x + b0 * ray_y) + c0) * d + d0) / divisor;
    y[i] = (((a1 * ray_x + b1 * ray_y) + c1) * d + d1) / divisor;
    z[i] = divisor;
    reading[i] = visible ? d : 0.0F;
    lost += (d > 0) & (ray_x != ray_x);
  }
  return lost;
}

inline void bend_row(const math::Lens lens, int64_t width, float* __restrict x, float* __restrict y,
                     float* __restrict reading) {
  for (int64_t i = 0; i < width; ++i) {
    const bool visible = (reading[i] > 0) & lens.within_fold(x[i], y[i]);
    reading[i] = visible ? reading[i] : 0.0F;
    float bent_x = visible ? x[i] : 0.0F, bent_y = visible ? y[i] : 0.0F;
    lens.bend(bent_x, bent_y);
    x[i] = bent_x;
    y[i] = bent_y;
  }
}

// Turn x/z and y/z into pixels, in place, and size their boxes. Returns how many readings lie beyond kFarthest.
inline int32_t to_pixels(const DepthView& view, const float* __restrict depth, const float* __restrict z,
                         const float* __restrict reading, int64_t width, float* __restrict u, float* __restrict v,
                         float* __restrict half_width, float* __restrict half_height) {
  const float fx = view.fx, skew = view.skew, cx = view.cx, fy = view.fy, cy = view.cy;
  const float box_width = view.half_width, box_height = view.half_height;
  int32_t beyond = 0;
  for (int64_t i = 0; i < width; ++i) {
    const float nearness = depth[i] / z[i], half_u = box_width * nearness, half_v = box_height * nearness;
    const float pixel_u = (fx * u[i] + skew * v[i]) + cx, pixel_v = fy * v[i] + cy;
    const bool near = (std::fabs(pixel_u) <= kFarthest) & (std::fabs(pixel_v) <= kFarthest) & (half_u <= kFarthest) &
                      (half_v <= kFarthest);
    u[i] = pixel_u;
    v[i] = pixel_v;
    half_width[i] = half_u;
    half_height[i] = half_v;
    beyond += (reading[i] > 0) & !near;
  }
  return beyond;
}

// Returns whether every reading has a ray and projects where floats can be computed with.
inline bool project(const DepthView& view, int64_t row, const ProjectedRow& seen) {
  const int64_t width = view.width;
  const float* depth = view.depth + row * width;
  const int32_t lost = view.rays != nullptr ? move_row(view, depth, PixelRays{view.rays + 2 * row * width}, width,
                                                       seen.u, seen.v, seen.z, seen.reading)
                                            : move_row(view, depth, PinholeRays{view.column_rays, view.row_rays[row]},
                                                       width, seen.u, seen.v, seen.z, seen.reading);
  if (view.lens != nullptr) bend_row(*view.lens, width, seen.u, seen.v, seen.reading);
  const int32_t beyond =
      to_pixels(view, depth, seen.z, seen.reading, width, seen.u, seen.v, seen.half_width, seen.half_height);
  return lost + beyond == 0;
}

}  // namespace pc::images
