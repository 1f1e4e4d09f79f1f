// Depth images rendered as color cameras see them: project every reading, paint its cell into a z-buffer whose nearest
// key stays whoever comes first, and say which readings the color camera does not see.
#pragma once

#include "pc/gpu/deprojection.hpp"
#include "pc/math/registration.hpp"

namespace pc::gpu {

constexpr uint64_t kUnpainted = ~uint64_t{0};  // as an index: -1

// Readings as the color cameras see them, planes of all pixels: u, v, z, and the depth, 0 where one is not seen.
struct SeenReadings {
  float* plane;
  int64_t pixels;

  PC_HD float& u(int64_t pixel) const { return plane[pixel]; }
  PC_HD float& v(int64_t pixel) const { return plane[pixels + pixel]; }
  PC_HD float& z(int64_t pixel) const { return plane[2 * pixels + pixel]; }
  PC_HD float& reading(int64_t pixel) const { return plane[3 * pixels + pixel]; }
};

struct ColorCameras {
  const double *color_from_depth, *intrinsics, *half_pixels;  // (views, 4, 4), (views, 3, 3), (views, 2)
  const double* lenses;                                       // (views, 14) or null

  PC_HD math::ColorCamera camera(int64_t view) const {
    return math::ColorCamera::of(color_from_depth + 16 * view, intrinsics + 9 * view, half_pixels + 2 * view);
  }
  PC_HD math::Lens lens(int64_t view) const { return *reinterpret_cast<const math::Lens*>(lenses + 14 * view); }
};
static_assert(sizeof(math::Lens) == 14 * sizeof(double), "lenses are rows of 14 numbers");

#define PC_REGISTRATION_PARAMETERS                                                            \
  PC_DEPTH_IMAGES_PARAMETERS, const double *color_from_depth, const double *color_intrinsics, \
      const double *half_pixels, const double *lenses, float *seen
#define PC_REGISTRATION                                                                                 \
  PC_DEPTH_IMAGES;                                                                                      \
  [[maybe_unused]] const ColorCameras cameras{color_from_depth, color_intrinsics, half_pixels, lenses}; \
  const SeenReadings readings { seen, images.pixels() }

// Project every reading. Sets `impossible` (1,) where one has no ray, or projects so far off that floats cannot be
// computed with.
PC_KERNEL(pc_see_readings, PC_REGISTRATION_PARAMETERS, int32_t* impossible) {
  const int64_t pixel = thread_index();
  PC_REGISTRATION;
  if (pixel >= images.pixels()) return;
  const int64_t view = images.view_of(pixel);
  const math::ColorCamera camera = cameras.camera(view);
  const math::Ray ray = images.ray(pixel);
  const float z = depth[pixel];
  math::MovedReading moved = camera.moved(ray.x, ray.y, z);
  if (lenses != nullptr) moved = math::bent(cameras.lens(view), moved);
  const math::SeenReading at = camera.seen(moved.x, moved.y, moved.z, z);
  if ((z > 0 && ray.x != ray.x) || (moved.reading > 0 && !at.is_near())) *impossible = 1;
  readings.u(pixel) = at.u;
  readings.v(pixel) = at.v;
  readings.z(pixel) = moved.z;
  readings.reading(pixel) = moved.reading;
}

// Paint the cell of every reading into `keys` (views, color_height, color_width), which start as kUnpainted; nothing if
// the readings were impossible.
PC_KERNEL(pc_paint_cells, PC_REGISTRATION_PARAMETERS, const int32_t* impossible, double max_jump, int64_t color_height,
          int64_t color_width, uint64_t* keys) {
  const int64_t pixel = thread_index();
  PC_REGISTRATION;
  if (pixel >= images.pixels() || *impossible != 0 || !(readings.reading(pixel) > 0)) return;
  const int64_t row = pixel / width, column = pixel - row * width, view = row / height;
  const int64_t image_row = row - view * height;
  const math::ColorCamera camera = cameras.camera(view);
  const float nearness = depth[pixel] / readings.z(pixel), jump = static_cast<float>(max_jump);
  math::CellEnds across, down;
  bool all_linked = true;
  for (int corner = 0; corner < 4; ++corner) {
    const int64_t right = corner % 2, below = corner / 2;
    bool linked = column + right > 0 && column + right < width && image_row + below > 0 && image_row + below < height;
    if (linked) {
      const int64_t a = pixel + (below - 1) * width + right - 1, b = a + 1, c = a + width, d = c + 1;
      linked = math::on_one_surface(readings.reading(a), readings.reading(c), readings.reading(b), readings.reading(d),
                                    jump);
      across.reach(linked, math::corner_between(readings.u(a), readings.u(b), readings.u(c), readings.u(d)));
      down.reach(linked, math::corner_between(readings.v(a), readings.v(b), readings.v(c), readings.v(d)));
    }
    all_linked = all_linked && linked;
  }
  across.reach_around(readings.u(pixel), camera.half_width * nearness, all_linked);
  down.reach_around(readings.v(pixel), camera.half_height * nearness, all_linked);
  const float limit_u = static_cast<float>(color_width), limit_v = static_cast<float>(color_height);
  const int32_t left = math::CellEnds::cut(across.low, limit_u), right = math::CellEnds::cut(across.high, limit_u);
  const int32_t top = math::CellEnds::cut(down.low, limit_v), bottom = math::CellEnds::cut(down.high, limit_v);
  const uint64_t key =
      static_cast<uint64_t>(bits_of(readings.z(pixel))) << 32 | static_cast<uint64_t>(image_row * width + column);
  uint64_t* image = keys + view * color_height * color_width;
  for (int64_t v = top; v < bottom; ++v)
    for (int64_t u = left; u < right; ++u) atomic_min(image + v * color_width + u, key);
}

// Keys to depths, 0 where nothing was painted, and, in their place, indices; nothing occludes yet.
PC_KERNEL(pc_read_keys, int64_t count, uint64_t* keys, float* registered, uint8_t* occluding) {
  const int64_t i = thread_index();
  if (i >= count) return;
  const uint64_t key = keys[i];
  registered[i] = key == kUnpainted ? 0.0F : float_of(static_cast<uint32_t>(key >> 32));
  keys[i] = key == kUnpainted ? kUnpainted : key & 0xFFFFFFFFu;
  occluding[i] = 0;
}

// Say which readings the color camera does not see, and where a nearer surface is why.
PC_KERNEL(pc_find_hidden, PC_REGISTRATION_PARAMETERS, double farthest, int64_t color_height, int64_t color_width,
          const float* registered, uint8_t* hidden, uint8_t* occluding) {
  const int64_t pixel = thread_index();
  PC_REGISTRATION;
  if (pixel >= images.pixels()) return;
  const float u = floorf(readings.u(pixel) + 0.5F), v = floorf(readings.v(pixel) + 0.5F);
  const bool inside = readings.reading(pixel) > 0 && u >= 0 && u < static_cast<float>(color_width) && v >= 0 &&
                      v < static_cast<float>(color_height);
  if (!inside) {
    hidden[pixel] = depth[pixel] > 0;
    return;
  }
  const int64_t target =
      (images.view_of(pixel) * color_height + static_cast<int64_t>(v)) * color_width + static_cast<int64_t>(u);
  const float front = registered[target];
  const bool is_hidden = front > 0 && readings.z(pixel) > static_cast<float>(farthest) * front;
  hidden[pixel] = is_hidden;
  if (is_hidden) occluding[target] = 1;
}

}  // namespace pc::gpu
