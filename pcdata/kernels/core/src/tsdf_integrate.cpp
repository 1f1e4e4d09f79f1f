// Averaging depth images into a truncated signed distance field.
#include "pc/math/fusion.hpp"
#include "pc/threads.hpp"
#include "pc/tsdf/lanes.hpp"
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

// Call body(first voxel) for each of some groups.
template <class Body>
void for_each(const GroupSet& groups, Body&& body) {
  for (int word = 0; word < GroupSet::kWords; ++word)
    for (uint32_t left = groups.words[word]; left != 0; left &= left - 1)
      body((32 * word + __builtin_ctz(left)) * kLanes);
}

// Sends for the voxels that a view may update, some lines at a time and not into the first cache: all at once they
// would fill the ways to memory and hold up what is being updated meanwhile.
class Fetch {
 public:
  Fetch(const VoxelPlanes& planes, const ProjectedBlock& block)
      : tsdf_(planes.tsdf.block(block.row)),
        weight_(planes.weight.block(block.row)),
        color_(planes.color ? planes.color.block(block.row) : nullptr) {
    for (int line = 0; line < kLines; ++line) {
      const uint32_t groups = block.groups.words[line * kPerLine / 32] >> line * kPerLine % 32;
      lines_ |= uint32_t{(groups & ((1u << kPerLine) - 1)) != 0} << line;
    }
  }

  void one() {
    if (lines_ == 0) return;
    const int at = __builtin_ctz(lines_) * kInLine;
    lines_ &= lines_ - 1;
    __builtin_prefetch(tsdf_ + at, 0, kIntoSecond);
    __builtin_prefetch(weight_ + at, 0, kIntoSecond);
    if (color_ == nullptr) return;
    __builtin_prefetch(color_ + at, 0, kIntoSecond);
    __builtin_prefetch(color_ + at + kInLine / 2, 0, kIntoSecond);
  }
  void rest() {
    while (lines_ != 0) one();
  }

 private:
  static constexpr int kIntoSecond = 1;                                                        // cache
  static constexpr int kInLine = 32, kLines = kVoxels / kInLine, kPerLine = kInLine / kLanes;  // voxels, lines, groups

  const int16_t *tsdf_, *weight_;
  const int32_t* color_;
  uint32_t lines_ = 0;  // still to be sent for
};

// What a view says about some voxels.
struct Sight {
  FloatRegister scaled;  // their distances, as stored; far behind the surface where it says nothing
  Int32Register place;   // of their pixels
};

template <class Pixels, bool kInside, bool kBent>
class Sights {
 public:
  Sights(const FusedView& view, const ProjectedBlock& block)
      : view_(view), depth_(view, block, view.depth), places_(view, block) {
    for (int a = 0; a < 3; ++a) first_[a] = FloatRegister{} + block.first[a];
  }

  Sight of(int at) const {
    constexpr float nothing = -1e30f;
    const FloatRegister zero = {};
    const float* const steps = view_.steps + at;
    const FloatRegister z = first_[2] + load<FloatRegister>(steps + 2 * kVoxels);
    const FloatRegister inverse = 1.0f / z;
    FloatRegister u = (first_[0] + load<FloatRegister>(steps)) * inverse;
    FloatRegister v = (first_[1] + load<FloatRegister>(steps + kVoxels)) * inverse;
    RegisterMask counts = all_lanes();
    if constexpr (kBent) {
      const float fx = view_.pinhole[0], skew = view_.pinhole[1], cx = view_.pinhole[2], fy = view_.pinhole[3];
      const FloatRegister radius = u * u + v * v;
      counts = less(radius, zero + view_.lens[12]);
      math::bend_normalized(view_.lens, u, v, radius);
      u = ((u * fx + v * skew) + cx) + 0.5f;
      v = (v * fy + view_.pinhole[4]) + 0.5f;
    }
    if constexpr (!kInside) {
      const auto width = static_cast<float>(view_.width), height = static_cast<float>(view_.height);
      counts = counts & less(zero, z) & less_equal(zero, u) & less(u, zero + width) & less_equal(zero, v) &
               less(v, zero + height);
      u = select(counts, u, zero);
      v = select(counts, v, zero);
    }
    const Int32Register place = places_.of(truncated(u), truncated(v));
    const FloatRegister reading = depth_.at(place);
    FloatRegister scaled = (reading - z) * view_.scale;
    if constexpr (!kInside) scaled = select(counts & less(zero, reading), scaled, zero + nothing);
    return {scaled, place};
  }

 private:
  const FusedView& view_;
  typename Pixels::template Table<float> depth_;
  typename Pixels::Places places_;
  FloatRegister first_[3];
};

// Average what a view says into the voxels of a block. kMore: with weights, labels or views.
template <class Pixels, bool kInside, bool kBent, bool kMore>
void update(const FusedView& view, const VoxelPlanes& planes, const ProjectedBlock& block, Fetch& next) {
  const FloatRegister zero = {}, most = zero + kTsdfScale;
  const bool has_color = planes.color && view.color != nullptr, carve = view.carve;
  int16_t *const tsdfs = planes.tsdf.block(block.row), *const weights = planes.weight.block(block.row);
  int32_t* const colors = has_color ? planes.color.block(block.row) : nullptr;
  int16_t* const counts = kMore && planes.views ? planes.views.block(block.row) : weights;
  const bool has_labels = kMore && planes.label && view.label != nullptr, has_weights = kMore && view.weight != nullptr;
  using Table = typename Pixels::template Table<int32_t>;
  const auto* const none = reinterpret_cast<const int32_t*>(view.depth);
  const Sights<Pixels, kInside, kBent> sights(view, block);
  const Table pixel_colors(view, block, has_color ? view.color : none);
  const Table pixel_weights(view, block, has_weights ? view.weight : none);
  const Table pixel_labels(view, block, has_labels ? view.label : none);
  constexpr auto lasting = static_cast<int16_t>(kMaxWeight);
  for_each(block.groups, [&](int at) {
    next.one();
    const Sight sight = sights.of(at);
    const RegisterMask not_behind = less_equal(-most, sight.scaled);
    const RegisterMask near = less_equal(sight.scaled, most) & not_behind;
    const bool is_near = any(near);
    if (!is_near && !(carve && any(not_behind))) return;
    const auto old_weight = load<Int16Lanes>(weights + at);
    const Int16Lanes count = kMore ? load<Int16Lanes>(counts + at) : old_weight;
    const Int32Register wide_weight = widened(old_weight);
    RegisterMask seen = near;
    if (carve) seen = near | (not_behind & less(Int32Register{}, wide_weight));
    if (!is_near && !any(seen)) return;  // in front of the surface, where nothing was seen before
    const auto stored = load<Int16Lanes>(tsdfs + at);
    const FloatRegister more = has_weights ? as_float(pixel_weights.at(sight.place)) : zero + 1;
    const FloatRegister sum = as_float(wide_weight) + more;
    const FloatRegister share = more / sum;
    const FloatRegister before = as_float(widened(stored));
    const Int32Register average = rounded(before + (minimum(sight.scaled, most) - before) * share);
    store(tsdfs + at, select(seen, narrowed(average), stored));
    const Int16Lanes weight = has_weights ? narrowed(truncated(minimum(sum, zero + kMaxWeight)))
                                          : old_weight - (old_weight < lasting);  // a comparison is -1 where it holds
    store(weights + at, select(seen, weight, old_weight));
    if (kMore && counts != weights) store(counts + at, select(seen, count - (count < lasting), count));
    if (!is_near) return;  // seen past
    if (has_color) {
      const auto color = load<Int32Register>(colors + at);
      const Int32Register mixed =
          mixed_color(color, pixel_colors.at(sight.place), rounded(share * -32768), color_turn(widened(count), at));
      store(colors + at, select(near, mixed, color));
    }
    if constexpr (kMore) {
      if (has_labels)
        vote(planes.label.block(block.row) + at, planes.votes.block(block.row) + at, pixel_labels.at(sight.place),
             near);
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
void update(const FusedView& view, const VoxelPlanes& planes, const ProjectedBlock& block, Fetch& next) {
  if (view.lens != nullptr)
    update<ImagePixels, false, true, kMore>(view, planes, block, next);
  else if (!block.inside)
    update<ImagePixels, false, false, kMore>(view, planes, block, next);
  else
    with_pixels(block, [&](auto pixels) { update<decltype(pixels), true, false, kMore>(view, planes, block, next); });
}

template <bool kMore>
void integrate(const pc_context& context, const FusedView& view, const VoxelPlanes& planes, const int64_t* rows,
               int64_t num_rows, const int64_t* keys) {
  constexpr int64_t kBlocks = 64;
  const BlockProjector projector(view);
  parallel_for(context, num_rows, kBlocks, [&](int64_t begin, int64_t end, int64_t) {
    if (begin == end) return;
    const auto aimed = [&](int64_t i) {
      const int64_t row = rows[std::min(i, end - 1)];
      return projector.aim(keys[row], row);
    };
    ProjectedBlock here = aimed(begin), next = aimed(begin + 1);
    projector.judge(here);
    Fetch(planes, here).rest();
    for (int64_t i = begin; i < end; ++i) {
      const ProjectedBlock after = aimed(i + 2);
      projector.judge(next);
      Fetch fetch(planes, next);
      update<kMore>(view, planes, here, fetch);
      fetch.rest();
      here = next;
      next = after;
    }
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
