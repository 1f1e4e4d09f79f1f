// Which points lie around some of a cloud's, roughly and quickly.
#pragma once

#include "pc/cells/cells.hpp"

namespace pc::cells {

// Blocks of space twice the radius wide, hashed into a bitmap. Marking every block that a point's neighbors can
// lie in, at most two along each axis, leaves one look per point. Wider blocks, or two that share a bit, do no harm:
// they only pick points that turn out to be too far.
class BlockBitmap {
 public:
  BlockBitmap(const pc_context& context, ScratchFrame& scratch, const math::Bounds& box, float radius, int64_t marks) {
    for (int axis = 0; axis < 3; ++axis) low_[axis] = box.low[axis];
    per_length_ = static_cast<float>(1 / std::max(kSide * static_cast<double>(radius), box.extent() / kMostPerAxis));
    // 64 bits per marking point, of which it sets at most 8.
    bits_ = std::clamp(sort::bits_below<uint64_t>(static_cast<uint64_t>(marks) * 64), 12, 31);
    const int64_t words = int64_t{1} << (bits_ - 5);
    words_ = scratch.take<uint32_t>(words);
    parallel_for(context, words, 1 << 16,
                 [&](int64_t begin, int64_t end, int64_t) { std::fill(words_ + begin, words_ + end, 0u); });
  }

  void mark_around(const float* point) {  // many threads at once
    uint32_t first[3], last[3];
    for (int axis = 0; axis < 3; ++axis) {
      const float at = coordinate(point[axis], axis);
      first[axis] = static_cast<uint32_t>(at - kBlocksReach);
      last[axis] = static_cast<uint32_t>(at + kBlocksReach);
    }
    for (uint32_t x = first[0]; x <= last[0]; ++x)
      for (uint32_t y = first[1]; y <= last[1]; ++y)
        for (uint32_t z = first[2]; z <= last[2]; ++z) {
          const uint32_t bit = hash(x, y, z), mask = 1u << (bit & 31);
          uint32_t* word = words_ + (bit >> 5);
          if (!(__atomic_load_n(word, __ATOMIC_RELAXED) & mask)) __atomic_fetch_or(word, mask, __ATOMIC_RELAXED);
        }
  }

  // Write the points of [piece) in marked blocks to `rows`, rising; returns how many. Of points `within`, if not null.
  int64_t pick(const float* points, const uint8_t* within, Range piece, uint32_t* rows) const {
    Tile tile;
    alignas(64) uint32_t marked[kTile];
    int64_t picked = 0;
    for (int64_t begin = piece.begin; begin < piece.end; begin += kTile) {
      const int count = static_cast<int>(std::min<int64_t>(kTile, piece.end - begin));
      tile.load(points, nullptr, begin, count);
      uint32_t any = 0;
      for (int i = 0; i < count; ++i) {
        const uint32_t bit = hash(block(tile.x[i], 0), block(tile.y[i], 1), block(tile.z[i], 2));
        marked[i] = words_[bit >> 5] >> (bit & 31) & 1;
        any |= marked[i];
      }
      if (!any) continue;
      for (int i = 0; within != nullptr && i < count; ++i) marked[i] &= within[begin + i] != 0;
      for (int i = 0; i < count; ++i) {
        rows[picked] = static_cast<uint32_t>(begin + i);
        picked += marked[i];
      }
    }
    return picked;
  }

 private:
  // Coordinates are float: up to 4097 blocks they err by less than 1e-3 of a block, and a neighbor is at most
  // 1 / kSide = 0.488 of a block away.
  static constexpr double kMostPerAxis = 4096, kSide = 2.05;
  static constexpr float kBlocksReach = 0.495f;

  // One block of room below, so that a neighbor's coordinate is not negative.
  float coordinate(float value, int axis) const { return (value - low_[axis]) * per_length_ + 1; }
  uint32_t block(float value, int axis) const {
    return static_cast<uint32_t>(static_cast<int32_t>(coordinate(value, axis)));
  }
  uint32_t hash(uint32_t x, uint32_t y, uint32_t z) const {  // multiplicative: large odd numbers spread the low bits up
    return (x * 0x9E3779B1u + y * 0x85EBCA77u + z * 0xC2B2AE3Du) * 0x2C1B3C6Du >> (32 - bits_);
  }

  float low_[3], per_length_;
  int bits_;
  uint32_t* words_;
};

}  // namespace pc::cells
