// Clouds that still lie on depth images: their points at their pixels, what proves that a window of pixels holds all
// that is near, and an order for the tree of boxes that takes no sort.
//
// The proof is that of neighbors/window_proof.hpp: all points of the columns from some column on lie beyond a plane
// through the camera, whose slope is measured from the points. A grid that does not fit makes proofs fail, never wrong.
#pragma once

#include "pc/gpu/box_tree.hpp"
#include "pc/math/affine.hpp"
#include "pc/math/half_space.hpp"

namespace pc::gpu {

// Points at the pixels of images (clouds, height, width); row -1 where there is none.
struct PixelImage {
  const Placed* placed;
  int64_t clouds, height, width;
  const double* cameras;  // (clouds, 4, 4), what moves points into their camera's frame, or null

  PC_HD int64_t pixels() const { return height * width; }
  PC_HD math::Point in_camera(int64_t cloud, float x, float y, float z) const {
    return cameras == nullptr ? math::Point{x, y, z} : math::Affine(cameras + 16 * cloud)({x, y, z});
  }
};

#define PC_IMAGE_PARAMETERS \
  const float *placed_image, int64_t clouds, int64_t height, int64_t width, const double *cameras
#define PC_IMAGE \
  const PixelImage image { reinterpret_cast<const Placed*>(placed_image), clouds, height, width, cameras }

// Lay points at their pixels; the image starts without any.
PC_KERNEL(pc_lay_points, const float* points, const int64_t* ptr, int64_t clouds, int64_t rows, const int64_t* pixel,
          int64_t pixels, float* placed_image) {
  const int64_t row = thread_index();
  if (row >= filled(ptr, clouds, rows)) return;
  const float* p = points + 3 * row;
  reinterpret_cast<Placed*>(placed_image)[cloud_of(ptr, clouds, row) * pixels + pixel[row]] = {
      p[0], p[1], p[2], static_cast<int32_t>(row)};
}

// Numbers that are ordered as floats are, and back.
PC_HD int32_t ordered_slope(float slope) {
  const auto bits = static_cast<int32_t>(bits_of(slope));
  return bits < 0 ? bits ^ 0x7FFFFFFF : bits;
}
PC_HD float slope_of(int32_t number) {
  return float_of(static_cast<uint32_t>(number < 0 ? number ^ 0x7FFFFFFF : number));
}

constexpr int kStrip = 32;  // rows of pixels that a warp goes down

// The slopes of each column and row of pixels: `slopes` (clouds, 2 (width + height)), least x/z and least -x/z of every
// column, then y/z of every row, as ordered numbers, which start as that of infinity. Sets `unfit` (clouds,) where a
// point lies not before its camera. A warp for 32 columns of kStrip rows.
PC_BLOCK_KERNEL(pc_measure_slopes, PC_IMAGE_PARAMETERS, int32_t* slopes, int32_t* unfit) {
  PC_IMAGE;
  const int64_t across = (width + PC_WARP - 1) / PC_WARP, down = (height + kStrip - 1) / kStrip;
  const int64_t strip = thread_index() / PC_WARP;
  if (strip >= clouds * across * down) return;  // all of a warp
  const int64_t cloud = strip / across / down, first = strip / across % down * kStrip;
  const int64_t u = strip % across * PC_WARP + lane();
  const float infinity = float_of(0x7F800000u);
  int32_t* of_columns = slopes + cloud * 2 * (width + height);
  int32_t* of_lines = of_columns + 2 * width;
  float low = infinity, high = infinity;
  for (int64_t v = first; v < first + kStrip && v < height; ++v) {
    float line_low = infinity, line_high = infinity;
    const Placed p = u < width ? image.placed[(cloud * height + v) * width + u] : Placed{0, 0, 0, -1};
    if (p.row >= 0) {
      const math::Point at = image.in_camera(cloud, p.x, p.y, p.z);
      const float inverse = 1.0F / at.z, x = at.x * inverse, y = at.y * inverse;
      const bool fits =
          at.z > math::kLeastDepth && at.z < infinity && fabsf(x) < math::kMostSlope && fabsf(y) < math::kMostSlope;
      if (!fits) unfit[cloud] = 1;
      low = x < low ? x : low;
      high = -x < high ? -x : high;
      line_low = y;
      line_high = -y;
    }
    line_low = warp_min(line_low);
    line_high = warp_min(line_high);
    if (lane() == 0 && line_low < infinity) {
      atomic_min(of_lines + v, ordered_slope(line_low));
      atomic_min(of_lines + height + v, ordered_slope(line_high));
    }
  }
  if (u < width && low < infinity) {
    atomic_min(of_columns + u, ordered_slope(low));
    atomic_min(of_columns + width + u, ordered_slope(high));
  }
}

// Turn slopes into the half-spaces of all points from a column (or row) on, and of all up to it, in their place:
// `sides` (clouds, 2 (width + height), 2), first from, then up to, columns before rows. A block of four warps for each
// cloud.
PC_BLOCK_KERNEL(pc_bound_sides, int64_t height, int64_t width, const int32_t* slopes, float* sides) {
  const int kind = thread_in_block() / PC_WARP;  // columns from, columns up to, rows from, rows up to
  const int64_t count = kind < 2 ? width : height;
  const int64_t place =
      block_index() * 2 * (width + height) + (kind < 2 ? kind * width : 2 * width + (kind - 2) * height);
  const bool is_upto = kind % 2 == 1;
  const float infinity = float_of(0x7F800000u);
  float carried = infinity;
  for (int64_t first = 0; first < count; first += PC_WARP) {
    const int64_t step = first + lane(), at = place + (is_upto ? step : count - 1 - step);
    float least = step < count ? slope_of(slopes[at]) : infinity;
    for (int apart = 1; apart < PC_WARP; apart *= 2) {
      const float other = from_lane(least, lane() >= apart ? lane() - apart : lane());
      least = other < least ? other : least;
    }
    least = carried < least ? carried : least;
    carried = from_lane(least, PC_WARP - 1);
    if (step >= count) continue;
    const math::HalfSpace side = math::HalfSpace::of(is_upto ? -least : least);
    sides[2 * at] = side.a;
    sides[2 * at + 1] = side.b;
  }
}

// The order of pixels in tiles of 8 x 4, 4 x 8 of them to a block of 32 x 32, block after block.
struct Tiles {
  int64_t height, width;

  static constexpr int kSide = 32, kOfBlock = 32;

  PC_HD int64_t across() const { return (width + kSide - 1) / kSide; }
  PC_HD int64_t of_image() const { return across() * ((height + kSide - 1) / kSide) * kOfBlock; }
  // The pixel of a lane of a tile, counted over all images, -1 beyond its image.
  PC_HD int64_t pixel(int64_t tile, int lane) const {
    const int64_t cloud = tile / of_image(), block = tile % of_image() / kOfBlock;
    const int within = static_cast<int>(tile % kOfBlock);
    const int64_t u = block % across() * kSide + within % 4 * 8 + lane % 8;
    const int64_t v = block / across() * kSide + within / 4 * 4 + lane / 8;
    return u < width && v < height ? (cloud * height + v) * width + u : -1;
  }
};

// How many points each tile has; a warp for each.
PC_BLOCK_KERNEL(pc_count_tiles, PC_IMAGE_PARAMETERS, int32_t* counts) {
  PC_IMAGE;
  const Tiles tiles{height, width};
  const int64_t tile = thread_index() / PC_WARP;
  if (tile >= clouds * tiles.of_image()) return;  // all of a warp
  const int64_t pixel = tiles.pixel(tile, lane());
  const uint32_t there = ballot(pixel >= 0 && image.placed[pixel].row >= 0);
  if (lane() == 0) counts[tile] = count_bits(there);
}

// Lay points out tile by tile; `ends` is the running total of counts.
PC_BLOCK_KERNEL(pc_place_tiles, PC_IMAGE_PARAMETERS, const int32_t* ends, float* placed) {
  PC_IMAGE;
  const Tiles tiles{height, width};
  const int64_t tile = thread_index() / PC_WARP;
  if (tile >= clouds * tiles.of_image()) return;  // all of a warp
  const int64_t pixel = tiles.pixel(tile, lane());
  const bool is_there = pixel >= 0 && image.placed[pixel].row >= 0;
  const uint32_t there = ballot(is_there);
  if (!is_there) return;
  const int before = count_bits(there & ((uint32_t{1} << lane()) - 1));
  reinterpret_cast<Placed*>(placed)[ends[tile] - count_bits(there) + before] = image.placed[pixel];
}

}  // namespace pc::gpu
