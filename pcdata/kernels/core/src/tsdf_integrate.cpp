// Averaging depth images into a truncated signed distance field.
#include "pc/math/fusion.hpp"
#include "pc/threads.hpp"
#include "pc/tsdf/pixels.hpp"

namespace pc::tsdf {
namespace {

inline void vote(int32_t* label, int16_t* votes, const Int32Register& seen, RegisterMask near) {
  const Int32Register candidate = load<Int32Register>(label), lead = widened(votes);
  const RegisterMask open = equal(lead, Int32Register{});
  const Int32Register raised = minimum(lead + 1, Int32Register{} + 32767);
  const Int32Register after = select(equal(seen, candidate) | open, raised, lead - 1);
  store(label, select(near & open, seen, candidate));
  store_narrowed(votes, select(near, after, lead));
}

// A block on its way: what the view says about its voxels, while these come from memory.
struct PendingBlock {
  ProjectedBlock block;
  alignas(64) float distance[kVoxels];  // as stored; far behind the surface where the view says nothing
  alignas(64) int32_t place[kVoxels];   // of the pixel

  static constexpr float kNothing = -1e30f;
};

template <class Body>
void for_each_group(const ProjectedBlock& block, Body&& body) {
  for (int word = 0; word < (kGroups + 31) / 32; ++word)
    for (uint32_t left = block.groups[word]; left != 0; left &= left - 1)
      body((32 * word + __builtin_ctz(left)) * kLanes);
}

// Measure the distances of a block, send for the voxels to update, and leave out groups without any.
template <class Pixels, bool kInside, bool kBent>
void measure(const FusedView& view, const VoxelPlanes& planes, PendingBlock& turn) {
  ProjectedBlock& block = turn.block;
  const FloatRegister zero = {}, most = zero + kTsdfScale;
  const auto width = static_cast<float>(view.width), height = static_cast<float>(view.height);
  const typename Pixels::template Table<float> depth(view, block, view.depth);
  const int16_t *const tsdfs = planes.tsdf.block(block.row), *const weights = planes.weight.block(block.row);
  const int32_t* const colors = planes.color ? planes.color.block(block.row) : reinterpret_cast<const int32_t*>(tsdfs);
  const FloatRegister furthest = view.carve ? zero + std::numeric_limits<float>::infinity() : most;
  const typename Pixels::Places places(view, block);
  const FloatRegister first_u = zero + block.first[0], first_v = zero + block.first[1], first_z = zero + block.first[2];
  const float* const steps = view.steps;
  const float scale = view.scale;
  uint32_t kept[(kGroups + 31) / 32] = {};
  int last = 0;  // group with a voxel to update
  for_each_group(block, [&](int at) {
    const FloatRegister z = first_z + load<FloatRegister>(steps + 2 * kVoxels + at);
    const FloatRegister inverse = 1.0f / z;
    FloatRegister u = (first_u + load<FloatRegister>(steps + at)) * inverse;
    FloatRegister v = (first_v + load<FloatRegister>(steps + kVoxels + at)) * inverse;
    RegisterMask counts = all_lanes();
    if constexpr (kBent) {
      const float fx = view.pinhole[0], skew = view.pinhole[1], cx = view.pinhole[2], fy = view.pinhole[3];
      const FloatRegister radius = u * u + v * v;
      counts = less(radius, zero + view.lens[12]);
      math::bend_normalized(view.lens, u, v, radius);
      u = ((u * fx + v * skew) + cx) + 0.5f;
      v = (v * fy + view.pinhole[4]) + 0.5f;
    }
    if constexpr (!kInside) {
      counts = counts & less(zero, z) & less_equal(zero, u) & less(u, zero + width) & less_equal(zero, v) &
               less(v, zero + height);
      u = select(counts, u, zero);
      v = select(counts, v, zero);
    }
    const Int32Register place = places.of(truncated(u), truncated(v));
    const FloatRegister reading = depth.at(place);
    FloatRegister scaled = (reading - z) * scale;
    if constexpr (!kInside) scaled = select(counts & less(zero, reading), scaled, zero + PendingBlock::kNothing);
    store(turn.distance + at, scaled);
    store(turn.place + at, place);
    // Without branches: which groups these are, no processor foresees.
    const bool is_near = any(less_equal(scaled, furthest) & less_equal(-most, scaled));
    kept[at / kLanes / 32] |= static_cast<uint32_t>(is_near) << at / kLanes % 32;
    last = is_near ? at : last;
    __builtin_prefetch(tsdfs + last, 1);
    __builtin_prefetch(weights + last, 1);
    __builtin_prefetch(colors + last, 1);
  });
  std::copy(std::begin(kept), std::end(kept), block.groups);
}

// Average what was measured into the voxels. kMore: with weights, labels or views.
template <class Pixels, bool kMore>
void update(const FusedView& view, const VoxelPlanes& planes, const PendingBlock& turn) {
  const ProjectedBlock& block = turn.block;
  const FloatRegister zero = {}, most = zero + kTsdfScale;
  const bool has_color = planes.color && view.color != nullptr;
  int16_t *const tsdfs = planes.tsdf.block(block.row), *const weights = planes.weight.block(block.row);
  int32_t* const colors = has_color ? planes.color.block(block.row) : nullptr;
  int16_t* const counts = kMore && planes.views ? planes.views.block(block.row) : nullptr;
  const bool has_labels = kMore && planes.label && view.label != nullptr, has_weights = kMore && view.weight != nullptr;
  using Table = typename Pixels::template Table<int32_t>;
  const auto* const none = reinterpret_cast<const int32_t*>(view.depth);
  const Table pixel_colors(view, block, has_color ? view.color : none);
  const Table pixel_weights(view, block, has_weights ? view.weight : none);
  const Table pixel_labels(view, block, has_labels ? view.label : none);
  Int32Register lane;
  for (int i = 0; i < kLanes; ++i) lane[i] = i;
  for_each_group(block, [&](int at) {
    const auto scaled = load<FloatRegister>(turn.distance + at);
    const auto place = load<Int32Register>(turn.place + at);
    const RegisterMask near = less_equal(scaled, most) & less_equal(-most, scaled);
    const Int32Register old_weight = widened(weights + at);
    RegisterMask seen = near;
    if (view.carve) seen = seen | (less(most, scaled) & less(Int32Register{}, old_weight));
    const FloatRegister old = as_float(old_weight);
    const FloatRegister more = has_weights ? as_float(pixel_weights.at(place)) : zero + 1;
    const FloatRegister sum = old + more;
    const FloatRegister share = more / sum;
    const Int32Register stored = widened(tsdfs + at);
    const FloatRegister before = as_float(stored);
    const FloatRegister distance = minimum(scaled, most);
    store_narrowed(tsdfs + at, select(seen, rounded(before + (distance - before) * share), stored));
    store_narrowed(weights + at, select(seen, truncated(minimum(sum, zero + kMaxWeight)), old_weight));
    const Int32Register count = counts != nullptr ? widened(counts + at) : old_weight;
    if (has_color) {
      const Int32Register color = load<Int32Register>(colors + at);
      const Int32Register turn_up = math::color_turn<Int32Register>(count, lane + at);
      const Int32Register mixed =
          math::mixed_color<Int32Register>(color, pixel_colors.at(place), rounded(share * 32768), turn_up);
      store(colors + at, select(near, mixed, color));
    }
    if constexpr (kMore) {
      if (has_labels)
        vote(planes.label.block(block.row) + at, planes.votes.block(block.row) + at, pixel_labels.at(place), near);
      if (counts != nullptr)
        store_narrowed(counts + at, select(seen, minimum(count + 1, Int32Register{} + 32767), count));
    }
  });
}

// Call body(Pixels{}) with the way to look up a block's pixels.
template <class Body>
void with_pixels([[maybe_unused]] const ProjectedBlock& block, Body&& body) {
#if defined(PC_AVX512)
  if (block.entries == 64) return body(TablePixels<64>{});
  if (block.entries == 128) return body(TablePixels<128>{});
  if (block.entries == 256) return body(TablePixels<256>{});
#endif
  body(ImagePixels{});
}

template <bool kMore>
void integrate(const pc_context& context, const FusedView& view, const VoxelPlanes& planes, const int64_t* rows,
               int64_t num_rows, const int64_t* keys) {
  constexpr int64_t kBlocks = 64;
  constexpr int kAhead = 2;  // blocks on their way from memory
  const BlockProjector projector(view);
  parallel_for(context, num_rows, kBlocks, [&](int64_t begin, int64_t end, int64_t) {
    PendingBlock waiting[kAhead];
    const auto finish = [&](const PendingBlock& turn) {
      with_pixels(turn.block, [&](auto pixels) { update<decltype(pixels), kMore>(view, planes, turn); });
    };
    int64_t met = 0;
    for (int64_t i = begin; i < end; ++i) {
      PendingBlock& turn = waiting[met % kAhead];
      if (met >= kAhead) finish(turn);
      turn.block = projector.of(keys[rows[i]], rows[i]);
      with_pixels(turn.block, [&](auto pixels) {
        using Pixels = decltype(pixels);
        if (view.lens != nullptr)
          measure<ImagePixels, false, true>(view, planes, turn);
        else if (turn.block.inside)
          measure<Pixels, true, false>(view, planes, turn);
        else
          measure<ImagePixels, false, false>(view, planes, turn);
      });
      ++met;
    }
    for (int64_t i = std::max<int64_t>(0, met - kAhead); i < met; ++i) finish(waiting[i % kAhead]);
  });
}

}  // namespace
}  // namespace pc::tsdf

PC_EXPORT int32_t pc_tsdf_integrate(const pc_context* context, const float* depth, const int32_t* weight,
                                    const int32_t* color, const int32_t* label, int64_t height, int64_t width,
                                    const double* pose, double block_size, const float* steps, const float* pinhole,
                                    const float* lens, double scale, int64_t carve, const int64_t* rows,
                                    int64_t num_rows, const int64_t* keys, const int64_t* const* planes) {
  using namespace pc;
  using namespace pc::tsdf;
  return guarded([&] {
    const FusedView view{depth,     weight,     color, label,   height, width,
                         pose,      block_size, steps, pinhole, lens,   static_cast<float>(scale),
                         carve != 0};
    const VoxelPlanes voxels(planes);
    const bool more = weight != nullptr || label != nullptr || voxels.views;
    if (more)
      integrate<true>(*context, view, voxels, rows, num_rows, keys);
    else
      integrate<false>(*context, view, voxels, rows, num_rows, keys);
  });
}
