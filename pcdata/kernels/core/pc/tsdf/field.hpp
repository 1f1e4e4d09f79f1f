// The distances of a block and of what is around it: which edges of the grid cross zero, and the slopes there.
#pragma once

#include <cstring>

#include "pc/simd.hpp"
#include "pc/tsdf/walk.hpp"

namespace pc::tsdf {

constexpr int16_t kUnseen = -32768;  // no stored distance: those end at -32767

struct Field {
  SortedBlocks blocks;
  VoxelPlanes planes;
};

// A block that nothing was seen in stands in for one that is not there.
constexpr int16_t kNothing[kVoxels] = {};

struct Distances {
  typedef int16_t Line __attribute__((vector_size(2 * kEdge)));
  const int16_t *tsdf, *weight;

  static Distances of(const Field& field, int64_t place) {
    if (place < 0) return {kNothing, kNothing};
    const int64_t row = field.blocks.rows[place];
    return {field.planes.tsdf.block(row), field.planes.weight.block(row)};
  }
  // Distances, those of weights that are not above `bound` as kUnseen: one, or a line of eight.
  int16_t at(int voxel, int16_t bound) const {
    const auto seen = static_cast<int16_t>(-static_cast<int16_t>(weight[voxel] > bound));
    return static_cast<int16_t>((tsdf[voxel] & seen) | (kUnseen & ~seen));
  }
  Line line(int voxel, int16_t bound) const {
    const auto seen = load<Line>(weight + voxel) > bound;
    return (load<Line>(tsdf + voxel) & seen) | (kUnseen & ~seen);
  }
  void copy_line(int voxel, int16_t* to, int16_t bound) const { store(to, line(voxel, bound)); }
};

// -- which edges cross zero ---------------------------------------------------------------------------------------

// A bit per edge: of every slab, those along x, y and z, one word each.
struct Marks {
  uint64_t along[kEdge][3];

  uint64_t any(int z) const { return along[z][0] | along[z][1] | along[z][2]; }
  int64_t count() const {
    int64_t total = 0;
    for (const auto& slab : along)
      for (const uint64_t word : slab) total += __builtin_popcountll(word);
    return total;
  }
};

// A block's own voxels and the first ones of the next blocks.
class EdgeEnds {
 public:
  Marks marks(const Distances& own, const Distances& right, const Distances& below, const Distances& behind,
              int16_t bound) {
    for (int z = 0; z < kEdge; ++z) {
      for (int y = 0; y < kEdge; ++y) own.copy_line(kSlab * z + kEdge * y, value_ + kPitch * z + kEdge * y, bound);
      below.copy_line(kSlab * z, value_ + kPitch * z + kSlab, bound);
    }
    for (int y = 0; y < kEdge; ++y) behind.copy_line(kEdge * y, value_ + kPitch * kEdge + kEdge * y, bound);
    Marks marks;
    for (int z = 0; z < kEdge; ++z) {
      const int16_t* here = value_ + kPitch * z;
      int16_t next[kSlab];
      std::memcpy(next, here + 1, sizeof next);
      for (int y = 0; y < kEdge; ++y) next[kEdge * y + kEdge - 1] = right.at(kSlab * z + kEdge * y, bound);
      marks.along[z][0] = crossing(here, next);
      marks.along[z][1] = crossing(here, here + kEdge);
      marks.along[z][2] = crossing(here, here + kPitch);
    }
    return marks;
  }

 private:
  static constexpr int kPitch = kSlab + kEdge;

  // Apart in sign, by at most 32767: 16 bits hold the difference. An unseen end is too far from one of the other sign.
  static uint64_t crossing(const int16_t* here, const int16_t* there) {
    int16_t crosses[kSlab];  // below zero where it does
    for (int i = 0; i < kSlab; ++i) {
      const int16_t low = std::min(here[i], there[i]), high = std::max(here[i], there[i]);
      const auto apart = static_cast<int16_t>(high - low);
      crosses[i] = static_cast<int16_t>(low & ~high & ~apart);
    }
    return signs_of(crosses);
  }

  int16_t value_[kPitch * (kEdge + 1)];
};

// -- slopes -------------------------------------------------------------------------------------------------------

// A block with two voxels of what is around it, in lines of 16: voxels -2 .. 10 along each axis, and more along x.
constexpr int kSide = kEdge + 5, kLine = 16;
constexpr int kStride[3] = {1, kLine, kSide * kLine};
constexpr int kPlaces = kSide * kSide * kLine;

constexpr int place_of(int x, int y, int z) { return ((z + 2) * kSide + (y + 2)) * kLine + (x + 2); }

// Lines of the block with its margin, both ends within.
struct LineRange {
  int y0, y1, z0, z1;

  LineRange wider(int y, int z) const { return {y0 - y, y1 + y, z0 - z, z1 + z}; }
  // Call body(first place, last place + 1) for every z: lines follow one another.
  template <class Body>
  void each(const Body& body) const {
    for (int z = z0; z <= z1; ++z) body(place_of(-2, y0, z), place_of(-2, y1 + 1, z));
  }
  // The lines on which the ends of marked edges lie.
  static LineRange of(const Marks& marks) {
    uint64_t all = 0;
    int z0 = kEdge, z1 = 0;
    for (int z = 0; z < kEdge; ++z)
      if (const uint64_t any = marks.any(z)) {
        all |= any;
        z0 = std::min(z0, z);
        z1 = z;
      }
    return {__builtin_ctzll(all) / kEdge, (63 - __builtin_clzll(all)) / kEdge + 1, z0, z1 + 1};
  }
};

class BlockMargin {
 public:
  void fill(const Distances near[27], const LineRange& lines) {
    for (int z = lines.z0; z <= lines.z1; ++z)
      for (int row = -1; row <= 1; ++row) {  // of blocks
        const int begin = std::max(lines.y0, kEdge * row), end = std::min(lines.y1, kEdge * row + kEdge - 1);
        const Distances* const three = near + 13 + 3 * row + 9 * (z >> 3);
        const Distances left = three[-1], middle = three[0], right = three[1];
        for (int y = begin; y <= end; ++y) {
          const int line = (z & 7) * kSlab + (y & 7) * kEdge;
          int16_t* const to = value_ + kBefore + place_of(0, y, z);
          // In this order: what runs over the end of a line is overwritten by the next.
          const auto before = left.line(line, 0);
          std::memcpy(to - 2, reinterpret_cast<const char*>(&before) + sizeof before - 4, 4);
          middle.copy_line(line, to, 0);
          right.copy_line(line, to + kEdge, 0);
        }
      }
  }

  // For every voxel on these lines and every axis, the sum of the rises between the voxels one and two steps on either
  // side, weighted 4, 2, 1 from the middle to the corners of the 3 x 3 lines along the axis; and 2^24 times the sum of
  // the steps, weighted likewise. A pair with an unseen end does not count. Both sums fit one number: the steps' is at
  // most 16 * (1 + 2) = 48, the rises' size at most 16 * 2 * 65534 < 2^23.
  void find_slopes(const LineRange& lines) {
    constexpr int widen_y[3] = {1, 0, 1}, widen_z[3] = {1, 1, 0}, one[3] = {1, 0, 0}, other[3] = {2, 2, 1};
    for (int axis = 0; axis < 3; ++axis) {
      pair_up(kStride[axis], lines.wider(widen_y[axis], widen_z[axis]));
      // Across x first, or across y: what is smoothed second must be there one line further.
      const bool last_is_z = other[axis] == 2;
      smooth(pairs_, kStride[one[axis]], half_, lines.wider(last_is_z ? 0 : 1, last_is_z ? 1 : 0));
      smooth(half_, kStride[other[axis]], slopes_[axis], lines);
    }
  }

  int16_t value(int place) const { return value_[kBefore + place]; }
  int32_t slope(int axis, int place) const { return slopes_[axis][kBefore + place]; }

  // The rise to the one neighbor that was seen, twice if there are two, none if there is none.
  float rise_to_seen(int place, int axis) const {
    const int16_t here = value(place), below = value(place - kStride[axis]), above = value(place + kStride[axis]);
    return static_cast<float>((above == kUnseen ? here : above) - (below == kUnseen ? here : below));
  }

 private:
  static constexpr int kBefore = 16;  // room that loops over whole lines may read, its content goes nowhere
  static constexpr int kRoom = kBefore + kPlaces + 2 * kLine;

  void pair_up(int stride, const LineRange& lines) {
    lines.each([&](int begin, int end) {
      const int16_t* middle = value_ + kBefore;
      int32_t* to = pairs_ + kBefore;
      for (int i = begin; i < end; ++i) to[i] = pair(middle[i - stride], middle[i + stride], 1);
      for (int i = begin; i < end; ++i) to[i] += pair(middle[i - 2 * stride], middle[i + 2 * stride], 2);
    });
  }
  static int32_t pair(int16_t below, int16_t above, int32_t step) {
    const int32_t both = (step << 24) + (above - below);
    return (below != kUnseen) & (above != kUnseen) ? both : 0;
  }
  static void smooth(const int32_t* from, int stride, int32_t* to, const LineRange& lines) {
    lines.each([&](int begin, int end) {
      for (int i = kBefore + begin; i < kBefore + end; ++i) to[i] = from[i - stride] + 2 * from[i] + from[i + stride];
    });
  }

  alignas(64) int16_t value_[kRoom] = {};
  alignas(64) int32_t pairs_[kRoom] = {}, half_[kRoom] = {}, slopes_[3][kRoom] = {};
};

}  // namespace pc::tsdf
