// Who is in front at every pixel, whichever thread comes first.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstring>

#include "pc/memory.hpp"
#include "pc/threads.hpp"

namespace pc::images {

constexpr int64_t kPixelsPerPiece = int64_t{1} << 16;
constexpr uint64_t kNothing = ~uint64_t{0};

// The depth above the row: the bits of positive floats are ordered as they are, so the smaller key is in front.
inline uint64_t front_key(float depth, int64_t row) {
  uint32_t bits;
  std::memcpy(&bits, &depth, sizeof bits);
  return uint64_t{bits} << 32 | static_cast<uint64_t>(row);
}

// Keys of pixels that other threads bring keys to as well.
struct SharedPixels {
  uint64_t* key;

  void bring(int64_t pixel, uint64_t one) const {
    auto* shared = reinterpret_cast<std::atomic<uint64_t>*>(key + pixel);
    uint64_t seen = shared->load(std::memory_order_relaxed);
    while (one < seen && !shared->compare_exchange_weak(seen, one, std::memory_order_relaxed)) {}
  }
};

// Keys of pixels that are this thread's alone.
struct OwnPixels {
  uint64_t* key;

  void bring(int64_t pixel, uint64_t one) const { key[pixel] = std::min(key[pixel], one); }
};

// Views of some pixels each, filled from the ragged rows of their clouds.
struct ZBuffer {
  const pc_context& context;
  int64_t views, pixels;
  float* depth;    // (views, pixels)
  int64_t* index;  // (views, pixels); the keys lie here until all are known

  uint64_t* keys(int64_t view) const { return reinterpret_cast<uint64_t*>(index) + view * pixels; }

  void clear() const {
    parallel_for(context, views * pixels, kPixelsPerPiece,
                 [&](int64_t begin, int64_t end, int64_t) { std::fill(keys(0) + begin, keys(0) + end, kNothing); });
  }
  // Turn keys into depths and rows; nothing is depth 0 and row `missing`.
  void read(int64_t missing) const {
    parallel_for(context, views * pixels, kPixelsPerPiece,
                 [&](int64_t begin, int64_t end, int64_t) { read(begin, end, missing); });
  }

  // Call draw(piece, the pixels of its view) for all rows. Many small images are cleared, drawn and read one after
  // another, while they are in the cache; the pixels of large ones are shared by the threads.
  template <class Draw>
  void run(const int64_t* ptr, int64_t missing, int64_t rows_per_piece, Draw&& draw) const {
    if (pixels <= kFewPixels && views >= 4 * int64_t{context.threads}) {
      parallel_for(context, views, std::max<int64_t>(1, kFewPixels / std::max<int64_t>(pixels, 1)),
                   [&](int64_t first, int64_t last, int64_t) {
                     for (int64_t view = first; view < last; ++view) {
                       std::fill(keys(view), keys(view + 1), kNothing);
                       draw(CloudPiece{view, ptr[view], ptr[view + 1]}, OwnPixels{keys(view)});
                       read(view * pixels, (view + 1) * pixels, missing);
                     }
                   });
      return;
    }
    clear();
    const auto pieces = cut_clouds(ptr, views, rows_per_piece);
    for_each_piece(context, pieces, rows_per_piece, [&](const CloudPiece& piece, int64_t) {
      if (context.threads == 1)
        draw(piece, OwnPixels{keys(piece.cloud)});
      else
        draw(piece, SharedPixels{keys(piece.cloud)});
    });
    read(missing);
  }

 private:
  static constexpr int64_t kFewPixels = int64_t{1} << 15;

  void read(int64_t begin, int64_t end, int64_t missing) const {
    const uint64_t* key = keys(0);
    for (int64_t i = begin; i < end; ++i) {
      const bool found = key[i] != kNothing;
      const uint32_t bits = found ? static_cast<uint32_t>(key[i] >> 32) : 0;
      std::memcpy(depth + i, &bits, sizeof bits);
      index[i] = found ? static_cast<int64_t>(key[i] & 0xFFFFFFFFu) : missing;
    }
  }
};

}  // namespace pc::images
