// The blocks that a depth image touches.
#include <cmath>

#include "pc/memory.hpp"
#include "pc/simd.hpp"
#include "pc/sort/radix.hpp"
#include "pc/tsdf/grid.hpp"
#include "pc/voxels/table.hpp"

namespace pc::tsdf {
namespace {

struct TouchingView {
  const float* depth;  // (height, width)
  const float* rays;   // (2, height, width)
  int64_t height, width;
  const float* turn;      // (3, 3) world from camera, in blocks per metre
  const float* fraction;  // (3,) where the camera is, in its block
  const int64_t* camera;  // (3,) the block that it is in
  const float* offsets;   // (num_offsets,) along z
  int64_t num_offsets;
};

// The three coordinates of a block, counted from the camera's, in 32 bits.
struct NearBlock {
  static constexpr int32_t kNone = INT32_MIN;                // no reading; z = -512, which is not used
  static constexpr int32_t kWide = 1 << 10, kDeep = 1 << 9;  // x and y, z lie below

  static bool fits(int axis, int32_t least, int32_t most) {
    const int32_t limit = axis == 2 ? kDeep : kWide;
    return least > -limit && most < limit;
  }
  static Int32Register pack(const Int32Register& x, const Int32Register& y, const Int32Register& z) {
    return (x & 2047) | (y & 2047) << 11 | z << 22;
  }
  static int32_t x(int32_t packed) { return static_cast<int32_t>(static_cast<uint32_t>(packed) << 21) >> 21; }
  static int32_t y(int32_t packed) { return static_cast<int32_t>(static_cast<uint32_t>(packed) << 10) >> 21; }
  static int32_t z(int32_t packed) { return packed >> 22; }
};

// The blocks of a row of pixels at every offset.
class BlockRow {
 public:
  BlockRow(ScratchFrame& scratch, const TouchingView& view)
      : stride_((view.width + kLanes) / kLanes * kLanes + kLanes),
        packed_(scratch.take<int32_t>(view.num_offsets * stride_)) {
    std::fill(packed_, packed_ + view.num_offsets * stride_, NearBlock::kNone);
  }
  // Entry u + 1 is that of pixel u, so that each has one on its left.
  int32_t* at(int64_t step) const { return packed_ + step * stride_; }

 private:
  int64_t stride_;
  int32_t* packed_;
};

// The lanes of some pixels of a row.
struct Pixels {
  FloatRegister depth, along[3];  // the way of their rays through blocks, per metre of depth

  Pixels(const TouchingView& view, int64_t row, int64_t u) {
    const int64_t at = row * view.width + u;
    depth = load_up_to(view.depth + at, view.width);
    const FloatRegister x = load_up_to(view.rays + at, view.width);
    const FloatRegister y = load_up_to(view.rays + view.height * view.width + at, view.width);
    for (int a = 0; a < 3; ++a) {
      const float* m = view.turn + 3 * a;
      along[a] = (m[0] * x + m[1] * y) + m[2];
    }
  }
};

// The range of the blocks of a row.
struct Extent {
  Int32Register low[3] = {}, high[3] = {};

  void join(int axis, const Int32Register& place) {
    low[axis] = minimum(low[axis], place);
    high[axis] = maximum(high[axis], place);
  }
};

enum class Reach { kNear, kWide, kFar };

// Find the blocks of a row of pixels at every offset.
inline Reach locate(const TouchingView& view, int64_t row, const BlockRow& here) {
  Extent extent;
  const FloatRegister zero = {};
  const Int32Register none = Int32Register{} + NearBlock::kNone;
  const int64_t last = std::max<int64_t>(0, view.width - kLanes);
  for (int64_t at = 0; at < view.width; at += kLanes) {
    const int64_t u = std::min(at, last);
    const Pixels pixels(view, row, u);
    const RegisterMask read = less(zero, pixels.depth);
    for (int64_t step = 0; step < view.num_offsets; ++step) {
      const FloatRegister z = pixels.depth + view.offsets[step];
      const RegisterMask good = read & less(zero, z);
      Int32Register place[3];
      for (int a = 0; a < 3; ++a) {
        place[a] = select(good, floored(pixels.along[a] * z + view.fraction[a]), Int32Register{});
        extent.join(a, place[a]);
      }
      store(here.at(step) + 1 + u, select(good, NearBlock::pack(place[0], place[1], place[2]), none));
    }
  }
  bool fits = true;
  for (int a = 0; a < 3; ++a) {
    const int32_t low = lowest_lane<int32_t>(extent.low[a]), high = highest_lane<int32_t>(extent.high[a]);
    fits = fits && NearBlock::fits(a, low, high);
    if (low + view.camera[a] <= -kBlocksPerSide || high + view.camera[a] >= kBlocksPerSide) return Reach::kFar;
  }
  return fits ? Reach::kNear : Reach::kWide;
}

// Write each pixel's blocks that are not those of the pixel to the left, of the one above, or of the same pixel one
// offset before; return how many. There must be room for a register more.
inline int64_t find_new(const TouchingView& view, const BlockRow& above, const BlockRow& here, int32_t* found) {
  int64_t count = 0;
  for (int64_t step = 0; step < view.num_offsets; ++step) {
    const int32_t *own = here.at(step), *other = above.at(step), *before = here.at(std::max<int64_t>(0, step - 1));
    const int32_t first = step == 0 ? -1 : 0;  // turns every bit over: before the first offset nothing was found
    for (int64_t u = 1; u <= view.width; u += kLanes) {
      const auto packed = load<Int32Register>(own + u);
      const RegisterMask is_new = unequal(packed, load<Int32Register>(own + u - 1)) &
                                  unequal(packed, load<Int32Register>(other + u)) &
                                  unequal(packed, load<Int32Register>(before + u) ^ first) &
                                  unequal(packed, Int32Register{} + NearBlock::kNone);
      count += store_chosen(found + count, packed, is_new);
    }
  }
  return count;
}

// Most of these are found again and again, by neighboring pixels in turn: leave out what was met lately.
class Recent {
 public:
  Recent() { std::fill(std::begin(packed_), std::end(packed_), NearBlock::kNone); }

  int64_t drop_known(int32_t* blocks, int64_t count) {
    int64_t kept = 0;
    for (int64_t i = 0; i < count; ++i) {
      const int32_t block = blocks[i];
      int32_t& last = packed_[static_cast<uint32_t>(block) * 0x9E3779B1u >> 21];
      blocks[kept] = block;
      kept += last != block;  // without a branch, which nothing would foresee
      last = block;
    }
    return kept;
  }

 private:
  int32_t packed_[1 << 11];
};

// For a row whose blocks do not fit: call found(x, y, z) for all.
template <class Found>
void find_all(const TouchingView& view, int64_t row, Found&& found) {
  for (int64_t u = 0; u < view.width; ++u) {
    const int64_t at = row * view.width + u;
    const float depth = view.depth[at], x = view.rays[at], y = view.rays[view.height * view.width + at];
    for (int64_t step = 0; step < view.num_offsets; ++step) {
      const float z = depth + view.offsets[step];
      if (!(depth > 0 && z > 0)) continue;
      int64_t place[3];
      for (int a = 0; a < 3; ++a) {
        const float* m = view.turn + 3 * a;
        place[a] = static_cast<int64_t>(std::floor(((m[0] * x + m[1] * y) + m[2]) * z + view.fraction[a]));
      }
      found(place[0], place[1], place[2]);
    }
  }
}

struct KeyItem {
  uint64_t key;
};

// Write the sorted, distinct keys to `found`; return how many, or -1 if a block lies out of reach.
int64_t touched(const pc_context& context, const TouchingView& view, int64_t* found) {
  constexpr int64_t kRows = 16;
  ScratchFrame scratch;
  const int64_t most = view.height * view.width * view.num_offsets;
  const auto threads = static_cast<size_t>(std::max<int32_t>(1, context.threads));
  struct Own {
    math::PackedVoxel* keys;
    BlockRow rows[2], none;
    int32_t* found;
    voxels::VoxelTable<math::PackedVoxel> table;
    Recent recent{};
    bool used = false;
  };
  std::vector<Own> own;
  for (size_t t = 0; t < threads; ++t)
    own.push_back({scratch.take<math::PackedVoxel>(most),
                   {BlockRow(scratch, view), BlockRow(scratch, view)},
                   BlockRow(scratch, view),
                   scratch.take<int32_t>(view.width * view.num_offsets + 2 * kLanes),
                   voxels::VoxelTable<math::PackedVoxel>(scratch, most)});
  std::atomic<bool> far{false};
  parallel_for(context, view.height, kRows, [&](int64_t begin, int64_t end, int64_t thread) {
    Own& mine = own[static_cast<size_t>(thread)];
    if (!mine.used) mine.table.start(mine.keys);
    mine.used = true;
    const auto key_of = [&](int64_t x, int64_t y, int64_t z) {
      const BlockPlace block{x + view.camera[0], y + view.camera[1], z + view.camera[2]};
      return math::PackedVoxel{static_cast<uint64_t>(block.key())};
    };
    const auto near_key = [&](int32_t packed) {
      return key_of(NearBlock::x(packed), NearBlock::y(packed), NearBlock::z(packed));
    };
    const BlockRow* above = &mine.none;
    for (int64_t row = begin; row < end; ++row) {
      const BlockRow& here = mine.rows[row % 2];
      const Reach reach = locate(view, row, here);
      if (reach == Reach::kFar) far.store(true, std::memory_order_relaxed);
      if (reach == Reach::kWide)
        find_all(view, row, [&](int64_t x, int64_t y, int64_t z) { mine.table.number(key_of(x, y, z)); });
      const BlockRow& last = *above;
      above = reach == Reach::kNear ? &here : &mine.none;
      if (reach != Reach::kNear) continue;
      const int64_t count = mine.recent.drop_known(mine.found, find_new(view, last, here, mine.found));
      constexpr int64_t kAhead = 8;
      for (int64_t i = 0; i < count; ++i) {
        if (i + kAhead < count) mine.table.prefetch(near_key(mine.found[i + kAhead]));
        mine.table.number(near_key(mine.found[i]));
      }
    }
  });
  if (far) return -1;
  int64_t total = 0;
  for (const Own& one : own) total += one.used ? one.table.count() : 0;
  KeyItem* items = scratch.take<KeyItem>(total);
  KeyItem* spare = scratch.take<KeyItem>(total);
  int64_t count = 0;
  for (const Own& one : own)
    for (int64_t i = 0; one.used && i < one.table.count(); ++i) items[count++] = {one.keys[i].bits};
  const KeyItem* sorted = sort::radix_sort(context, scratch, items, spare, even_pieces(context, total), 63);
  count = 0;
  for (int64_t i = 0; i < total; ++i)
    if (i == 0 || sorted[i].key != sorted[i - 1].key) found[count++] = static_cast<int64_t>(sorted[i].key);
  return count;
}

}  // namespace
}  // namespace pc::tsdf

PC_EXPORT int32_t pc_tsdf_touched(const pc_context* context, const float* depth, const float* rays, int64_t height,
                                  int64_t width, const float* turn, const float* fraction, const int64_t* camera,
                                  const float* offsets, int64_t num_offsets, int64_t* found, int64_t* count) {
  using namespace pc;
  using namespace pc::tsdf;
  return guarded([&] {
    *count = touched(*context, {depth, rays, height, width, turn, fraction, camera, offsets, num_offsets}, found);
  });
}
