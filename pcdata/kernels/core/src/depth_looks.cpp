// What is asked of every depth image of a stream: whether it can be, and whether it is the one before.
#include <cmath>
#include <cstring>
#include <limits>

#include "pc/memory.hpp"
#include "pc/simd.hpp"
#include "pc/threads.hpp"

namespace pc::images {
namespace {

constexpr int64_t kLookedAtOnce = 1 << 16, kBlock = 1 << 12;  // the second stays in the nearest cache

struct Extremes {
  float least, largest;
  int32_t wrong;  // not 0 where one is NaN or infinite

  // Plain loops over values of which there is at least one: they vectorize.
  static Extremes of(const float* __restrict values, int64_t count) {
    Extremes found{values[0], values[0], 0};
    for (int64_t i = 0; i < count; ++i) found.wrong |= values[i] - values[i] != 0;
    FloatRegister low = FloatRegister{} + values[0], high = low;
    int64_t i = 0;
    for (; i + kLanes <= count; i += kLanes) {
      const auto some = load<FloatRegister>(values + i);
      low = minimum(some, low);
      high = maximum(some, high);
    }
    found.least = lowest_lane<float>(low);
    found.largest = highest_lane<float>(high);
    for (; i < count; ++i) found.add({values[i], values[i], 0});
    return found;
  }
  void add(const Extremes& other) {
    least = std::min(least, other.least);
    largest = std::max(largest, other.largest);
    wrong |= other.wrong;
  }
};

bool differ(const float* __restrict a, const float* __restrict b, int64_t count) {
  int32_t found = 0;
  for (int64_t i = 0; i < count; ++i) found |= a[i] != b[i];
  return found != 0;
}

}  // namespace
}  // namespace pc::images

PC_EXPORT int32_t pc_look_at_depth(const pc_context* context, const float* depth, int64_t count, const float* before,
                                   float* copy, float* extremes, int64_t* same) {
  using namespace pc;
  using namespace pc::images;
  return guarded([&] {
    ScratchFrame scratch;
    const int64_t pieces = (count + kLookedAtOnce - 1) / kLookedAtOnce;
    auto* of_piece = scratch.take<Extremes>(pieces);
    std::atomic<bool> is_same{before != nullptr};
    parallel_for(*context, count, kLookedAtOnce, [&](int64_t begin, int64_t end, int64_t) {
      Extremes& found = of_piece[begin / kLookedAtOnce];
      for (int64_t at = begin; at < end; at += kBlock) {
        const int64_t some = std::min(kBlock, end - at);
        const Extremes own = Extremes::of(depth + at, some);
        if (at == begin)
          found = own;
        else
          found.add(own);
        if (is_same.load(std::memory_order_relaxed) && differ(depth + at, before + at, some))
          is_same.store(false, std::memory_order_relaxed);
        if (copy != nullptr) std::memcpy(copy + at, depth + at, static_cast<size_t>(some) * sizeof(float));
      }
    });
    Extremes all{0, 0, 0};
    for (int64_t piece = 0; piece < pieces; ++piece) {
      if (piece == 0)
        all = of_piece[0];
      else
        all.add(of_piece[piece]);
    }
    const float none = std::numeric_limits<float>::quiet_NaN();
    extremes[0] = all.wrong != 0 ? none : all.least;
    extremes[1] = all.wrong != 0 ? none : all.largest;
    *same = is_same;
  });
}
