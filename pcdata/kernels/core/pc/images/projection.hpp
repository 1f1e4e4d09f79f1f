// Rows of depth pixels projected into a color camera. The float32 operations are the reference's, in its order.
#pragma once

#include <cmath>
#include <cstdint>

#include "pc/math/registration.hpp"

namespace pc::images {

// One view's depth image (height, width) and both cameras.
struct DepthView {
  const float* depth;
  int64_t height, width;
  const float* column_rays = nullptr;  // x/z of every column (width,) and
  const float* row_rays = nullptr;     // y/z of every row (height,); or null, and then
  const float* rays = nullptr;         // both of every pixel (height, width, 2)
  math::ColorCamera camera = {};
  const math::Lens* lens = nullptr;  // of the color camera, if it has one

  DepthView(const float* image, int64_t rows, int64_t columns) : depth(image), height(rows), width(columns) {}
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
  const math::ColorCamera camera = view.camera;
  int32_t lost = 0;
  for (int64_t i = 0; i < width; ++i) {
    const float ray_x = ray.x(i), d = depth[i];
    const math::MovedReading moved = camera.moved(ray_x, ray.y(i), d);
    x[i] = moved.x;
    y[i] = moved.y;
    z[i] = moved.z;
    reading[i] = moved.reading;
    lost += (d > 0) & (ray_x != ray_x);
  }
  return lost;
}

inline void bend_row(const math::Lens lens, int64_t width, float* __restrict x, float* __restrict y,
                     float* __restrict reading) {
  for (int64_t i = 0; i < width; ++i) {
    const math::MovedReading found = math::bent(lens, {x[i], y[i], 1.0F, reading[i]});
    x[i] = found.x;
    y[i] = found.y;
    reading[i] = found.reading;
  }
}

// Turn x/z and y/z into pixels, in place, and size their boxes. Returns how many readings lie too far off.
inline int32_t to_pixels(const DepthView& view, const float* __restrict depth, const float* __restrict z,
                         const float* __restrict reading, int64_t width, float* __restrict u, float* __restrict v,
                         float* __restrict half_width, float* __restrict half_height) {
  const math::ColorCamera camera = view.camera;
  int32_t beyond = 0;
  for (int64_t i = 0; i < width; ++i) {
    const math::SeenReading seen = camera.seen(u[i], v[i], z[i], depth[i]);
    u[i] = seen.u;
    v[i] = seen.v;
    half_width[i] = seen.half_width;
    half_height[i] = seen.half_height;
    beyond += (reading[i] > 0) & !seen.is_near();
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
