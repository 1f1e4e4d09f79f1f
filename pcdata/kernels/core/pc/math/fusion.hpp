// What a view does to the voxels of a truncated signed distance field, and what lies where it crosses zero: the
// operations of pcdata/functional/tsdf in their order. F: float, or a register of floats; I: int32_t, or a register.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

// -- a view -------------------------------------------------------------------------------------------------------

// Bend normalized coordinates as OpenCV's lens with twelve coefficients does; r2 is the square of their length.
template <class F>
PC_HD void bend_normalized(const float* c, F& x, F& y, const F& r2) {
  const F radial = (1 + r2 * (c[0] + r2 * (c[1] + r2 * c[4]))) / (1 + r2 * (c[5] + r2 * (c[6] + r2 * c[7])));
  const F xy = (2 * x) * y;
  const F bent = ((x * radial + c[2] * xy) + c[3] * (r2 + (2 * x) * x)) + (c[8] + c[9] * r2) * r2;
  y = ((y * radial + c[2] * (r2 + (2 * y) * y)) + c[3] * xy) + (c[10] + c[11] * r2) * r2;
  x = bent;
}

// How a color is rounded, up or down in turn: in steps of 2^-15, for a voxel that so many views have colored.
template <class I>
PC_HD I color_turn(const I& views, const I& voxel) {
  return ((views * 159 + voxel * 83) & 255) << 7;
}

// The stored color with a pixel's averaged in; `share` in steps of 2^-15.
template <class I>
PC_HD I mixed_color(const I& old, const I& pixel, const I& share, const I& turn) {
  const I r = (((pixel & 1023) - (old & 1023)) * share + turn) >> 15;
  const I g = ((((pixel >> 10 & 1023) - (old >> 10 & 1023)) * share + turn) >> 15) * (1 << 10);  // may be negative
  const I b = ((((pixel >> 20 & 1023) - (old >> 20 & 1023)) * share + turn) >> 15) * (1 << 20);
  return ((old + r) + g) + b;
}

// -- a crossing ---------------------------------------------------------------------------------------------------

// Where between the ends of an edge the distance is zero.
PC_HD float crossing_fraction(float before, float after) { return before / (before - after); }

PC_HD float between(float before, float after, float fraction) { return before + (after - before) * fraction; }

// The rise per voxel; not a number where no pair of voxels was seen whole.
PC_HD float slope_between(int32_t rise0, int32_t rise1, float steps0, float steps1, float fraction) {
  const float rise = static_cast<float>(rise0) + static_cast<float>(rise1 - rise0) * fraction;
  return rise / (2 * between(steps0, steps1, fraction));
}

// A channel of a color, 0 to 1, between two stored ones.
PC_HD float channel_between(int32_t before, int32_t after, int channel, float fraction) {
  const float from = static_cast<float>(before >> 10 * channel & 1023);
  const float to = static_cast<float>(after >> 10 * channel & 1023);
  return between(from, to, fraction) * static_cast<float>(1.0 / 1020);
}

}  // namespace pc::math
