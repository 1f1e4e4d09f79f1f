// The points of a mask, one after another, and which rows they are.
#pragma once

#include <stdexcept>

#include "pc/memory.hpp"
#include "pc/rows/runs.hpp"
#include "pc/threads.hpp"

namespace pc::rows {

struct KeptPoints {
  const float* points;   // (kept, 3)
  const uint32_t* rows;  // (kept,)
};

// Gather the points (rows, 3) whose byte in the mask is true; they are `kept`, and rows less than 2^32. Memory is the
// scratch's, until its frame ends.
inline KeptPoints gather_kept_points(const pc_context& context, ScratchFrame& scratch, const float* points,
                                     const uint8_t* mask, int64_t rows, int64_t kept) {
  constexpr int64_t kPiece = 8192;
  const int64_t pieces = (rows + kPiece - 1) / kPiece;
  int64_t* starts = scratch.take<int64_t>(pieces + 1);
  starts[0] = 0;
  parallel_for(context, rows, kPiece, [&](int64_t begin, int64_t end, int64_t) {
    int64_t count = 0;
    for (int64_t row = begin; row < end; ++row) count += mask[row] != 0;
    starts[begin / kPiece + 1] = count;
  });
  for (int64_t piece = 0; piece < pieces; ++piece) starts[piece + 1] += starts[piece];
  if (starts[pieces] != kept) throw std::invalid_argument("a mask has other rows than is said");
  auto* kept_points = scratch.take<float>(3 * kept);
  auto* kept_rows = scratch.take<uint32_t>(kept);
  parallel_for(context, rows, kPiece, [&](int64_t begin, int64_t end, int64_t) {
    int64_t at = starts[begin / kPiece];
    for (int64_t first = begin; first < end; first += kStretch) {
      const int64_t count = std::min(kStretch, end - first);
      uint32_t own[kStretch];
      int32_t packed[3 * kStretch + kLanes];
      const auto take = [&](auto words, const void* from, void* to) {
        const int64_t found = pack_rows<words>(static_cast<const char*>(from), mask + first, count, packed);
        std::memcpy(to, packed, static_cast<size_t>(found * words) * sizeof(int32_t));
        return found;
      };
      for (int64_t i = 0; i < kStretch; ++i) own[i] = static_cast<uint32_t>(first + i);
      take(std::integral_constant<int, 1>(), own, kept_rows + at);
      at += take(std::integral_constant<int, 3>(), points + 3 * first, kept_points + 3 * at);
    }
  });
  return {kept_points, kept_rows};
}

}  // namespace pc::rows
