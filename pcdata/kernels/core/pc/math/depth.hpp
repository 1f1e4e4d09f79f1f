// Readings of depth images beside one another: surfaces, edges, averages. float32, with the operations of the
// references in their order; 0 is no reading.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

PC_HD float lower(float a, float b) { return a < b ? a : b; }
PC_HD float upper(float a, float b) { return a > b ? a : b; }

// Whether two pixels have readings that differ by at most this part of the nearer one.
PC_HD bool on_one_surface(float a, float b, float max_jump) {
  const float nearer = lower(a, b);
  return (nearer > 0) & (fabsf(a - b) <= max_jump * nearer);
}
// The same of four pixels, the farthest and the nearest of them.
PC_HD bool on_one_surface(float a, float b, float c, float d, float max_jump) {
  const float low = lower(lower(a, b), lower(c, d)), high = upper(upper(a, b), upper(c, d));
  return (low > 0) & (high - low <= max_jump * low);
}

// From a to b, as far as a part says.
PC_HD float mixed(float a, float b, float part) { return a + part * (b - a); }

// scale / value, `none` where there is no reading.
PC_HD float reciprocal(float value, float scale, float none) { return value > 0 ? scale / value : none; }

// An average along a line that starts anew at every edge.
struct LineAverage {
  float raw, mean;

  PC_HD float next(float own, float keep, float delta) {
    const float weight = fabsf(own - raw) < delta ? keep : 0.0F;
    mean = own + weight * (mean - own);
    raw = own;
    return mean;
  }
};

// A pixel over time: what it gives, and what is remembered of it.
struct OverTime {
  float filtered, last;
  int32_t history;

  PC_HD static OverTime step(float now, float before, int32_t history, float keep, float delta, int64_t needed,
                             int64_t frames) {
    const bool valid = now > 0, known = before > 0, steady = valid && known && fabsf(now - before) < delta;
    const float mixed = steady ? now + keep * (before - now) : now;
    int32_t left = history & ((1 << frames) - 1);
    for (int64_t i = 1; i < needed; ++i) left &= left - 1;
    const bool bridged = known && (needed == 0 || left != 0);
    const int32_t past = (history << 1) & 255;
    return {valid ? mixed : bridged ? before : 0.0F, valid ? mixed : before, valid ? (steady ? past : 0) | 1 : past};
  }
};

// 2 to the power of exponents up to 0, to 2e-7, with the same bits on every machine: see window_filters.py.
PC_HD float power_of_two(float given) {
  const float exponent = upper(given, -100.0F), whole = rintf(exponent), rest = exponent - whole;
  float value = 0.0013253462966531515F;
  value = value * rest + 0.009672367945313454F;
  value = value * rest + 0.055507998913526535F;
  value = value * rest + 0.24022223055362701F;
  value = value * rest + 0.6931468844413757F;
  value = value * rest + 1.0F;
  return value * float_of_bits(static_cast<uint32_t>(static_cast<int32_t>(whole) + 127) << 23);
}

}  // namespace pc::math
