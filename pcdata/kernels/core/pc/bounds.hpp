// The box around many points.
#pragma once

#include "pc/math/bounds.hpp"
#include "pc/simd.hpp"
#include "pc/threads.hpp"

namespace pc {

// Of points [begin, end), at least one. As many points as a register has lanes fill three, whose lanes hold x, y, z,
// x, ... in turn.
inline math::Bounds bounds_of(const float* points, int64_t begin, int64_t end) {
  const float* values = points + 3 * begin;
  const int64_t count = 3 * (end - begin);
  float low[3 * kLanes], high[3 * kLanes];
  for (int i = 0; i < 3 * kLanes; ++i) low[i] = high[i] = values[i % 3];
  FloatRegister lows[3], highs[3];
  std::memcpy(lows, low, sizeof lows);
  std::memcpy(highs, high, sizeof highs);
  int64_t i = 0;
  for (; i + 3 * kLanes <= count; i += 3 * kLanes) {
    for (int part = 0; part < 3; ++part) {
      const FloatRegister some = load<FloatRegister>(values + i + part * kLanes);
      lows[part] = minimum(some, lows[part]);
      highs[part] = maximum(some, highs[part]);
    }
  }
  std::memcpy(low, lows, sizeof lows);
  std::memcpy(high, highs, sizeof highs);
  math::Bounds bounds{{low[0], low[1], low[2]}, {high[0], high[1], high[2]}};
  for (int k = 3; k < 3 * kLanes; ++k) bounds.include(k % 3, low[k], high[k]);
  for (; i < count; ++i) bounds.include(static_cast<int>(i % 3), values[i], values[i]);
  return bounds;
}

inline math::Bounds hull(const std::vector<math::Bounds>& parts) {
  math::Bounds all = parts.front();
  for (const math::Bounds& part : parts) all.include(part);
  return all;
}

// The same of points (count, 3) with all threads.
inline math::Bounds parallel_bounds(const pc_context& context, const float* points, int64_t count) {
  const std::vector<Range> pieces = even_pieces(context, count);
  std::vector<math::Bounds> parts(pieces.size());
  parallel_for(context, static_cast<int64_t>(pieces.size()), 1, [&](int64_t p, int64_t, int64_t) {
    const Range piece = pieces[static_cast<size_t>(p)];
    parts[static_cast<size_t>(p)] = bounds_of(points, piece.begin, piece.end);
  });
  return hull(parts);
}

}  // namespace pc
