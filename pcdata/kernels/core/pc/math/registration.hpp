// Depth pixels as a color camera sees them, in float32 with the operations of the reference in their order: where they
// are seen, and the cells between their corners.
#pragma once

#include "pc/math/depth.hpp"
#include "pc/math/lens.hpp"

namespace pc::math {

// Beyond it sums of coordinates could overflow, and what infinities become is the reference's to say.
constexpr float kFarthestPixel = 1e30F;
constexpr float kNoEnd = 3e38F;  // farther than any

// A reading in the color camera: x/z and y/z, z, and the depth that was read, 0 where the camera cannot see it.
struct MovedReading {
  float x, y, z, reading;
};

// Where it is seen, and half the width and height of its box.
struct SeenReading {
  float u, v, half_width, half_height;

  PC_HD bool is_near() const {
    return (fabsf(u) <= kFarthestPixel) & (fabsf(v) <= kFarthestPixel) & (half_width <= kFarthestPixel) &
           (half_height <= kFarthestPixel);
  }
};

// A color camera and the way to it.
struct ColorCamera {
  float move[12];  // the upper rows of color_from_depth
  float fx, skew, cx, fy, cy;
  float half_width, half_height;  // of a pixel's box, in color pixels, at equal depths

  // color_from_depth (4, 4), color_intrinsics (3, 3), half_pixel (2,)
  PC_HD static ColorCamera of(const double* color_from_depth, const double* k, const double* half_pixel) {
    ColorCamera camera;
    for (int i = 0; i < 12; ++i) camera.move[i] = static_cast<float>(color_from_depth[i]);
    camera.fx = static_cast<float>(k[0]);
    camera.skew = static_cast<float>(k[1]);
    camera.cx = static_cast<float>(k[2]);
    camera.fy = static_cast<float>(k[4]);
    camera.cy = static_cast<float>(k[5]);
    camera.half_width = static_cast<float>(half_pixel[0]);
    camera.half_height = static_cast<float>(half_pixel[1]);
    return camera;
  }
  PC_HD MovedReading moved(float ray_x, float ray_y, float depth) const {
    const float z = along(8, ray_x, ray_y, depth);
    const bool visible = (depth > 0) & (z > 0);
    const float divisor = visible ? z : 1.0F;
    return {along(0, ray_x, ray_y, depth) / divisor, along(4, ray_x, ray_y, depth) / divisor, divisor,
            visible ? depth : 0.0F};
  }
  PC_HD SeenReading seen(float x, float y, float z, float depth) const {
    const float nearness = depth / z;
    return {(fx * x + skew * y) + cx, fy * y + cy, half_width * nearness, half_height * nearness};
  }

 private:
  PC_HD float along(int row, float x, float y, float depth) const {
    return ((move[row] * x + move[row + 1] * y) + move[row + 2]) * depth + move[row + 3];
  }
};

// Bend x/z and y/z as the color camera's lens does; the reading is 0 where the lens does not see it.
PC_HD MovedReading bent(const Lens& lens, const MovedReading& moved) {
  const bool visible = (moved.reading > 0) & lens.within_fold(moved.x, moved.y);
  MovedReading found{visible ? moved.x : 0.0F, visible ? moved.y : 0.0F, moved.z, visible ? moved.reading : 0.0F};
  lens.bend(found.x, found.y);
  return found;
}

// The corner between two pixels above and two below.
PC_HD float corner_between(float above, float above_right, float below, float below_right) {
  return 0.25F * ((below_right + above_right) + (below + above));
}

// One coordinate's ends of a pixel's cell, that of the corners that are linked and, unless all are, half a pixel.
struct CellEnds {
  float low = kNoEnd, high = -kNoEnd;

  PC_HD void reach(bool is_linked, float corner) {
    low = lower(low, is_linked ? corner : kNoEnd);
    high = upper(high, is_linked ? corner : -kNoEnd);
  }
  PC_HD void reach_around(float center, float half, bool all_linked) {
    const float reach = all_linked ? -kNoEnd : half;
    low = lower(low, center - reach);
    high = upper(high, center + reach);
  }
  // The first pixel center within, of `limit`, and the one after the last.
  PC_HD static int32_t cut(float end, float limit) {
    return static_cast<int32_t>(lower(upper(ceilf(end), 0.0F), limit));
  }
};

}  // namespace pc::math
