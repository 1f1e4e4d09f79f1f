// The blocks that a depth image touches, and the table that finds blocks.
#include "pc/radix_sort.hpp"
#include "pc/tsdf.hpp"
#include "pc/voxel_table.hpp"

namespace pc {
namespace {

struct TouchingView {
  const float* depth;          // (height, width)
  const float* rays;           // (2, height, width)
  int64_t height, width;
  const float* turn;           // (3, 3) world from camera, in blocks per metre
  const float* fraction;       // (3,) where the camera is, in its block
  const int64_t* camera;       // (3,) the block that it is in
  const float* offsets;        // (num_offsets,) along z
  int64_t num_offsets;
};

// The blocks of a row of pixels at every offset, counted from the camera's.
class Row {
 public:
  static constexpr int32_t kNone = INT32_MIN;  // without a reading

  Row(ScratchFrame& scratch, const TouchingView& view)
      : stride_((view.width + kLanes) / kLanes * kLanes + kLanes), places_(scratch.take<int32_t>(3 * view.num_offsets * stride_)) {
    std::fill(places_, places_ + 3 * view.num_offsets * stride_, kNone);
  }
  // Entry u of the result is that of pixel u - 1, so that each has one on its left.
  int32_t* at(int64_t step, int axis) const { return places_ + (3 * step + axis) * stride_; }

 private:
  int64_t stride_;
  int32_t* places_;
};

// Find the blocks of a row of pixels; call found(x, y, z) for each pixel's that are not those of the pixel to the left,
// of the one above, or of the same pixel one offset before. False if a block lies out of reach.
template <class Found>
bool walk(const TouchingView& view, int64_t row, const Row& above, Row& here, Found&& found) {
  int32_t low[3], high[3];
  for (int a = 0; a < 3; ++a) {
    constexpr int64_t limit = int64_t{1} << 30;
    low[a] = static_cast<int32_t>(std::clamp(-kBlocksPerSide + 1 - view.camera[a], -limit, limit + 1));
    high[a] = static_cast<int32_t>(std::clamp(kBlocksPerSide - 1 - view.camera[a], -limit - 1, limit));
  }
  const float *m = view.turn, *depth = view.depth + row * view.width;
  const float *ray_x = view.rays + row * view.width, *ray_y = ray_x + view.height * view.width;
  IntLanes far = {};
  for (int64_t at = 0; at < view.width; at += kLanes) {
    const int64_t u = std::max<int64_t>(0, std::min(at, view.width - kLanes));
    const FloatLanes z = load_up_to(depth + u, view.width), x = load_up_to(ray_x + u, view.width);
    const FloatLanes y = load_up_to(ray_y + u, view.width);
    const FloatLanes zero = {};
    FloatLanes along[3];
    for (int a = 0; a < 3; ++a) along[a] = (m[3 * a] * x + m[3 * a + 1] * y) + m[3 * a + 2];
    for (int64_t step = 0; step < view.num_offsets; ++step) {
      const FloatLanes moved = z + view.offsets[step];
      const IntLanes read = (z > zero) & (moved > zero);
      for (int a = 0; a < 3; ++a) {
        const IntLanes place = floored(along[a] * moved + view.fraction[a]);
        far |= read & ((place < low[a]) | (place > high[a]));
        store(here.at(step, a) + 1 + u, read ? place : IntLanes{} + Row::kNone);
      }
    }
  }
  if (bits_of_lanes(far) != 0) return false;
  for (int64_t step = 0; step < view.num_offsets; ++step) {
    const int64_t before = step == 0 ? 0 : step - 1;
    const int32_t *x = here.at(step, 0), *y = here.at(step, 1), *z = here.at(step, 2);
    for (int64_t u = 1; u <= view.width; u += kLanes) {
      IntLanes is_new = IntLanes{} - 1;
      const auto compare = [&](const Row& other, int64_t other_step, int64_t shift) {
        IntLanes differs = {};
        for (int a = 0; a < 3; ++a)
          differs |= load<IntLanes>(here.at(step, a) + u) ^ load<IntLanes>(other.at(other_step, a) + u - shift);
        is_new &= differs != 0;
      };
      compare(here, step, 1);
      compare(above, step, 0);
      if (before != step) compare(here, before, 0);
      is_new &= load<IntLanes>(x + u) != Row::kNone;
      for (uint32_t bits = bits_of_lanes(is_new); bits != 0; bits &= bits - 1) {
        const int64_t i = u + __builtin_ctz(bits);
        found(x[i], y[i], z[i]);
      }
    }
  }
  return true;
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
    PackedVoxel* keys;
    Row rows[2], none;
    VoxelTable<PackedVoxel> table;
    bool used = false;
  };
  std::vector<Own> own;
  for (size_t t = 0; t < threads; ++t)
    own.push_back({scratch.take<PackedVoxel>(most), {Row(scratch, view), Row(scratch, view)}, Row(scratch, view),
                   VoxelTable<PackedVoxel>(scratch, most)});
  std::atomic<bool> far{false};
  parallel_for(context, view.height, kRows, [&](int64_t begin, int64_t end, int64_t thread) {
    Own& mine = own[static_cast<size_t>(thread)];
    if (!mine.used) mine.table.start(mine.keys);
    mine.used = true;
    const auto add = [&](int64_t x, int64_t y, int64_t z) {
      const BlockPlace block{x + view.camera[0], y + view.camera[1], z + view.camera[2]};
      mine.table.number({static_cast<uint64_t>(block.key())});
    };
    for (int64_t row = begin; row < end; ++row)
      if (!walk(view, row, row == begin ? mine.none : mine.rows[(row + 1) % 2], mine.rows[row % 2], add))
        far.store(true, std::memory_order_relaxed);
  });
  if (far) return -1;
  int64_t total = 0;
  for (const Own& one : own) total += one.used ? one.table.count() : 0;
  KeyItem* items = scratch.take<KeyItem>(total);
  KeyItem* spare = scratch.take<KeyItem>(total);
  int64_t count = 0;
  for (const Own& one : own)
    for (int64_t i = 0; one.used && i < one.table.count(); ++i) items[count++] = {one.keys[i].bits};
  const KeyItem* sorted = radix_sort(context, scratch, items, spare, even_pieces(context, total), 63);
  count = 0;
  for (int64_t i = 0; i < total; ++i)
    if (i == 0 || sorted[i].key != sorted[i - 1].key) found[count++] = static_cast<int64_t>(sorted[i].key);
  return count;
}

}  // namespace
}  // namespace pc

// depth (height, width), rays (2, height, width), turn (3, 3) and fraction (3,) in blocks, camera (3,) blocks, offsets
// (num_offsets,) -> the sorted keys of the touched blocks, found (*count,), of room for every reading at every offset.
// *count becomes -1 if a block lies out of reach.
PC_EXPORT int32_t pc_tsdf_touched(const pc_context* context, const float* depth, const float* rays, int64_t height,
                                  int64_t width, const float* turn, const float* fraction, const int64_t* camera,
                                  const float* offsets, int64_t num_offsets, int64_t* found, int64_t* count) {
  return pc::guarded([&] {
    *count = pc::touched(*context, {depth, rays, height, width, turn, fraction, camera, offsets, num_offsets}, found);
  });
}
