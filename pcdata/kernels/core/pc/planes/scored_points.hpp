// Some of a cloud's points, that many planes are counted on.
#pragma once

#include "pc/memory.hpp"
#include "pc/planes/plane_sums.hpp"
#include "pc/threads.hpp"

namespace pc::planes {

// The points of a cloud that planes are scored on: all, or one out of each of 2^bits stretches, as the reference says.
class ScoredPoints {
 public:
  ScoredPoints(const float* points, int64_t count, int64_t bits, ScratchFrame& scratch) {
    const bool is_all = bits > 40 || count <= int64_t{1} << bits;
    size_ = is_all ? count : int64_t{1} << bits;
    num_blocks_ = (size_ + PointBlock::kSize - 1) / PointBlock::kSize;
    blocks_ = scratch.take<PointBlock>(num_blocks_);
    for (int64_t b = 0; b < num_blocks_; ++b) {
      const int64_t begin = b * PointBlock::kSize, end = std::min(size_, begin + PointBlock::kSize);
      if (is_all) {
        blocks_[b].read(points, begin, end);
        continue;
      }
      float some[3 * PointBlock::kSize];
      for (int64_t i = begin; i < end; ++i) {
        const int64_t first = i * count >> bits, after = (i + 1) * count >> bits;
        const int64_t part = i * 2654435769 & 0xFFFFFFFF;
        std::memcpy(some + 3 * (i - begin), points + 3 * (first + (part * (after - first) >> 32)), 3 * sizeof(float));
      }
      blocks_[b].read(some, 0, end - begin);
    }
  }

  int64_t size() const { return size_; }
  int64_t num_blocks() const { return num_blocks_; }
  const PointBlock& block(int64_t index) const { return blocks_[index]; }

 private:
  int64_t size_, num_blocks_;
  PointBlock* blocks_;
};

}  // namespace pc::planes
