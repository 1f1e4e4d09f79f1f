// Averaging depth images into a truncated signed distance field.
#include "pc/tsdf_view.hpp"

namespace pc {
namespace {

// OpenCV's lens model, in the order of operations of the reference.
inline void bend(const float* c, FloatLanes& x, FloatLanes& y, const FloatLanes& r2) {
  const FloatLanes radial =
      (1 + r2 * (c[0] + r2 * (c[1] + r2 * c[4]))) / (1 + r2 * (c[5] + r2 * (c[6] + r2 * c[7])));
  const FloatLanes xy = (2 * x) * y;
  const FloatLanes bent = ((x * radial + c[2] * xy) + c[3] * (r2 + (2 * x) * x)) + (c[8] + c[9] * r2) * r2;
  y = ((y * radial + c[2] * (r2 + (2 * y) * y)) + c[3] * xy) + (c[10] + c[11] * r2) * r2;
  x = bent;
}

// Pixels of an image by their number.
struct ImagePixels {
  IntLanes number;

  ImagePixels(const View& view, const SeenBlock&, const IntLanes& u, const IntLanes& v)
      : number(v * (IntLanes{} + static_cast<int32_t>(view.width)) + u) {}
  template <class T>
  auto of(const T* image, const View&, const SeenBlock&) const {
    return gather(image, number);
  }
};

#if defined(__AVX512DQ__)
// Pixels of a window that four registers hold: two permutations instead of a gather's sixteen loads.
struct TablePixels {
  static constexpr int kTable = SeenBlock::kTable;
  IntLanes place;

  TablePixels(const View&, const SeenBlock& block, const IntLanes& u, const IntLanes& v)
      : place((v << 3) + u - (block.v * kTable + block.u)) {}
  template <class T>
  auto of(const T* image, const View& view, const SeenBlock& block) const {
    const T* from = image + block.v * view.width + block.u;
    __m512i rows[4];
    for (int i = 0; i < 4; ++i, from += 2 * view.width) {
      const __m256i first = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(from));
      const __m256i second = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(from + view.width));
      rows[i] = _mm512_inserti64x4(_mm512_castsi256_si512(first), second, 1);
    }
    const __m512i at = raw(place);
    const __m512i low = _mm512_permutex2var_epi32(rows[0], at, rows[1]);
    const __m512i high = _mm512_permutex2var_epi32(rows[2], at, rows[3]);
    const __m512i found = _mm512_mask_blend_epi32(_mm512_test_epi32_mask(at, _mm512_set1_epi32(32)), low, high);
    typedef T Lanes __attribute__((vector_size(4 * kLanes)));
    return reinterpret_cast<Lanes>(found);
  }
};
#endif

// The stored colour with a pixel's averaged in, rounded up or down in turn; `share` in steps of 2^-15, `turn` likewise.
inline IntLanes mixed_color(const IntLanes& old, const IntLanes& pixel, const IntLanes& share, const IntLanes& turn) {
  const auto step = [&](int shift) {
    const IntLanes apart = ((pixel >> shift) & 1023) - ((old >> shift) & 1023);
    return ((apart * share + turn) >> 15) << shift;
  };
  return ((old + step(0)) + step(10)) + step(20);
}

inline void vote(int32_t* label, int16_t* votes, const IntLanes& seen, Truth near) {
  const IntLanes candidate = load<IntLanes>(label), lead = widened(votes);
  const Truth open = equal(lead, IntLanes{});
  const IntLanes raised = least(lead + 1, IntLanes{} + 32767);
  const IntLanes after = select(equal(seen, candidate) | open, raised, lead - 1);
  store(label, select(near & open, seen, candidate));
  store_short(votes, select(near, after, lead));
}

// kMore: with weights, labels, views or carving. kInside: every voxel is known to fall on a pixel. kBent: with a lens.
template <class Pixels, bool kMore, bool kInside, bool kBent>
void update(const View& view, const VoxelPlanes& planes, const SeenBlock& block) {
  const FloatLanes zero = {}, most = zero + kTsdfScale;
  const auto width = static_cast<float>(view.width), height = static_cast<float>(view.height);
  const bool has_color = planes.color && view.color != nullptr;
  int16_t *const tsdfs = planes.tsdf.block(block.row), *const weights = planes.weight.block(block.row);
  int32_t* const colors = has_color ? planes.color.block(block.row) : nullptr;
  int16_t* const counts = kMore && planes.views ? planes.views.block(block.row) : nullptr;
  IntLanes lane;
  for (int i = 0; i < kLanes; ++i) lane[i] = i;

  for (int word = 0; word < (kGroups + 31) / 32; ++word)
    for (uint32_t left = block.groups[word]; left != 0; left &= left - 1) {
      const int at = (32 * word + __builtin_ctz(left)) * kLanes;
      const FloatLanes z = block.first[2] + load<FloatLanes>(view.steps + 2 * kVoxels + at);
      const FloatLanes inverse = 1.0f / z;
      FloatLanes u = (block.first[0] + load<FloatLanes>(view.steps + at)) * inverse;
      FloatLanes v = (block.first[1] + load<FloatLanes>(view.steps + kVoxels + at)) * inverse;
      Truth inside = all_lanes();
      if constexpr (kBent) {
        const float fx = view.pinhole[0], skew = view.pinhole[1], cx = view.pinhole[2], fy = view.pinhole[3];
        const FloatLanes radius = u * u + v * v;
        inside = less(radius, zero + view.lens[12]);
        bend(view.lens, u, v, radius);
        u = ((u * fx + v * skew) + cx) + 0.5f;
        v = (v * fy + view.pinhole[4]) + 0.5f;
      }
      if constexpr (!kInside) {
        inside = inside & less(zero, z) & at_most(zero, u) & less(u, zero + width) & at_most(zero, v) &
                 less(v, zero + height);
        if (!inside.any()) continue;
        u = select(inside, u, zero);
        v = select(inside, v, zero);
      }
      const Pixels pixel(view, block, truncated(u), truncated(v));
      const FloatLanes reading = pixel.of(view.depth, view, block);
      const FloatLanes scaled = (reading - z) * view.scale;
      inside = inside & less(zero, reading);
      const Truth near = inside & at_most(scaled, most) & at_most(-most, scaled);
      Truth seen = near;
      const IntLanes old_weight = widened(weights + at);
      if (kMore && view.carve) seen = seen | (inside & less(most, scaled) & less(IntLanes{}, old_weight));
      if (!seen.any()) continue;

      const FloatLanes old = as_float(old_weight);
      const FloatLanes more = kMore && view.weight != nullptr ? as_float(pixel.of(view.weight, view, block)) : zero + 1;
      const FloatLanes sum = old + more;
      const FloatLanes share = more / sum;
      const IntLanes stored = widened(tsdfs + at);
      const FloatLanes before = as_float(stored);
      const FloatLanes distance = kMore ? least(scaled, most) : scaled;  // of what is near, none is more
      store_short(tsdfs + at, select(seen, rounded(before + (distance - before) * share), stored));
      store_short(weights + at, select(seen, truncated(least(sum, zero + kMaxWeight)), old_weight));
      const IntLanes count = counts != nullptr ? widened(counts + at) : old_weight;
      if (has_color) {
        const IntLanes color = load<IntLanes>(colors + at);
        const IntLanes turn = ((count * 159 + (lane + at) * 83) & 255) << 7;
        const IntLanes mixed = mixed_color(color, pixel.of(view.color, view, block), rounded(share * 32768), turn);
        store(colors + at, select(near, mixed, color));
      }
      if constexpr (kMore) {
        if (planes.label && view.label != nullptr)
          vote(planes.label.block(block.row) + at, planes.votes.block(block.row) + at,
               pixel.of(view.label, view, block), near);
        if (counts != nullptr) store_short(counts + at, select(near, least(count + 1, IntLanes{} + 32767), count));
      }
    }
}

template <bool kMore>
void update(const View& view, const VoxelPlanes& planes, const SeenBlock& block) {
#if defined(__AVX512DQ__)
  if (block.is_small) return update<TablePixels, kMore, true, false>(view, planes, block);
#endif
  if (view.lens != nullptr) return update<ImagePixels, kMore, false, true>(view, planes, block);
  if (block.inside) return update<ImagePixels, kMore, true, false>(view, planes, block);
  update<ImagePixels, kMore, false, false>(view, planes, block);
}

// Bring what an update will read and write into the cache.
void prefetch(const VoxelPlanes& planes, const SeenBlock& block) {
  constexpr int kPerLine = 64 / sizeof(int16_t) / kLanes;  // groups
  const char* tsdf = reinterpret_cast<const char*>(planes.tsdf.block(block.row));
  const char* weight = reinterpret_cast<const char*>(planes.weight.block(block.row));
  const char* color = planes.color ? reinterpret_cast<const char*>(planes.color.block(block.row)) : nullptr;
  for (int g = 0; g < kGroups; g += kPerLine) {
    if ((block.groups[g / 32] >> g % 32 & ((1u << kPerLine) - 1)) == 0) continue;
    const int at = g * kLanes * static_cast<int>(sizeof(int16_t));
    __builtin_prefetch(tsdf + at, 1);
    __builtin_prefetch(weight + at, 1);
    if (color == nullptr) continue;
    __builtin_prefetch(color + 2 * at, 1);
    __builtin_prefetch(color + 2 * at + 64, 1);
  }
}

template <bool kMore>
void integrate(const pc_context& context, const View& view, const VoxelPlanes& planes, const int64_t* rows,
               int64_t num_rows, const int64_t* keys) {
  constexpr int64_t kGrain = 64;
  constexpr int kAhead = 3;  // blocks on their way from memory
  const Sight sight(view);
  parallel_for(context, num_rows, kGrain, [&](int64_t begin, int64_t end, int64_t) {
    SeenBlock waiting[kAhead];
    int64_t met = 0;
    for (int64_t i = begin; i < end; ++i) {
      const SeenBlock block = sight.of(keys[rows[i]], rows[i]);
      if (!block.any()) continue;
      prefetch(planes, block);
      SeenBlock& turn = waiting[met % kAhead];
      if (met >= kAhead) update<kMore>(view, planes, turn);
      turn = block;
      ++met;
    }
    for (int64_t i = std::max<int64_t>(0, met - kAhead); i < met; ++i) update<kMore>(view, planes, waiting[i % kAhead]);
  });
}

}  // namespace
}  // namespace pc

// Average one view into blocks rows (num_rows,), whose keys are keys[row]. planes: 6 arrays of chunk addresses (tsdf,
// weight, colour, views, label, votes), null where absent. The images and `lens` may be null, as in pc::View.
PC_EXPORT int32_t pc_tsdf_integrate(const pc_context* context, const float* depth, const int32_t* weight,
                                    const int32_t* color, const int32_t* label, int64_t height, int64_t width,
                                    const double* pose, double block_size, const float* steps, const float* pinhole,
                                    const float* lens, double scale, int64_t carve, const int64_t* rows,
                                    int64_t num_rows, const int64_t* keys, const int64_t* const* planes) {
  return pc::guarded([&] {
    const pc::View view{depth, weight,     color, label,   height, width,
                        pose,  block_size, steps, pinhole, lens,   static_cast<float>(scale), carve != 0};
    const pc::VoxelPlanes voxels(planes);
    const bool more = weight != nullptr || label != nullptr || carve != 0 || voxels.views;
    if (more)
      pc::integrate<true>(*context, view, voxels, rows, num_rows, keys);
    else
      pc::integrate<false>(*context, view, voxels, rows, num_rows, keys);
  });
}
