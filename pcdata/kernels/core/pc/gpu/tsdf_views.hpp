// Averaging a view into the voxels of blocks, and packing its colors.
#pragma once

#include "pc/gpu/tsdf_table.hpp"
#include "pc/math/fusion.hpp"

namespace pc::gpu {

constexpr int kTogether = 4;                   // voxels of a thread, beside one another along x
constexpr int kThreads = kVoxels / kTogether;  // of a block of voxels

// Four voxels of a plane, read and written at once.
struct alignas(8) FourNarrow {
  int16_t of[kTogether];
};
struct alignas(16) FourWide {
  int32_t of[kTogether];
};
template <class Four, class T>
PC_HD Four load_four(const T* from) {
  return *reinterpret_cast<const Four*>(from);
}
template <class Four, class T>
PC_HD void store_four(T* to, const Four& four) {
  *reinterpret_cast<Four*>(to) = four;
}

// The numbers of a view: 12 of the map from the world into the image, 9 steps from voxel to voxel, 5 of the pinhole, 13
// of the lens.
struct ProjectedVoxels {
  const double* numbers;
  bool is_bent;

  PC_HD float number(int at) const { return static_cast<float>(numbers[at]); }
  // The first voxel of a block, as the view maps it.
  PC_HD float corner(const BlockPlace& block, double block_size, int axis) const {
    const double x = static_cast<double>(block.x) * block_size, y = static_cast<double>(block.y) * block_size,
                 z = static_cast<double>(block.z) * block_size;
    const double* m = numbers + 4 * axis;
    return static_cast<float>(((m[0] * x + m[1] * y) + m[2] * z) + m[3]);
  }
  PC_HD float step(int voxel, int axis) const {
    const float x = static_cast<float>(voxel % kEdge), y = static_cast<float>(voxel / kEdge % kEdge),
                z = static_cast<float>(voxel / kSlab);
    return (x * number(12 + 3 * axis) + y * number(13 + 3 * axis)) + z * number(14 + 3 * axis);
  }
  // The pixel of a voxel that is mapped to (x, y, z); -1 if there is none.
  PC_HD int64_t pixel(float x, float y, float z, int64_t height, int64_t width) const {
    const float inverse = 1.0f / z;
    float u = x * inverse, v = y * inverse;
    bool is_seen = z > 0;
    if (is_bent) {
      const float radius = u * u + v * v;
      is_seen = is_seen && radius < number(38);
      float lens[12];
      for (int i = 0; i < 12; ++i) lens[i] = number(26 + i);
      math::bend_normalized(lens, u, v, radius);
      u = ((u * number(21) + v * number(22)) + number(23)) + 0.5f;
      v = (v * number(24) + number(25)) + 0.5f;
    }
    is_seen = is_seen && u >= 0 && u < static_cast<float>(width) && v >= 0 && v < static_cast<float>(height);
    return is_seen ? static_cast<int64_t>(v) * width + static_cast<int64_t>(u) : -1;
  }
};

// Count one vote; see integrate.py.
PC_HD void vote(int32_t& label, int16_t& votes, int32_t seen) {
  const int lead = votes;
  const bool is_open = lead == 0;
  votes = static_cast<int16_t>(seen == label || is_open ? (lead < 32767 ? lead + 1 : lead) : lead - 1);
  if (is_open) label = seen;
}

// kThreads threads for each of the rows; `weight`, `color` and `label` may be null.
PC_KERNEL(pc_integrate_view, const float* depth, const int32_t* weight, const int32_t* color, const int32_t* label,
          int64_t height, int64_t width, const double* numbers, int64_t is_bent, double block_size, double scale,
          int64_t carve, const int64_t* rows, int64_t num_rows, const int64_t* keys, PC_PLANES_PARAMETERS) {
  const int64_t number = thread_index() / kThreads;
  if (number >= num_rows) return;
  const int first = static_cast<int>(thread_index() % kThreads) * kTogether;
  const int64_t row = rows[number];
  const ProjectedVoxels view{numbers, is_bent != 0};
  const BlockPlace place = BlockPlace::of(keys[row]);
  const float corner[3] = {view.corner(place, block_size, 0), view.corner(place, block_size, 1),
                           view.corner(place, block_size, 2)};
  int64_t pixel[kTogether];
  float scaled[kTogether];
  bool near[kTogether], any_near = false, any_front = false;
  for (int i = 0; i < kTogether; ++i) {
    const float z = corner[2] + view.step(first + i, 2);
    pixel[i] = view.pixel(corner[0] + view.step(first + i, 0), corner[1] + view.step(first + i, 1), z, height, width);
    const float reading = pixel[i] < 0 ? 0.0f : depth[pixel[i]];
    scaled[i] = (reading - z) * static_cast<float>(scale);
    near[i] = reading > 0 && fabsf(scaled[i]) <= math::kTsdfScale;
    any_near |= near[i];
    const bool is_front = carve != 0 && reading > 0 && scaled[i] > math::kTsdfScale;
    if (!near[i] && !is_front) pixel[i] = -1;
    any_front |= is_front;
  }
  if (!any_near && !any_front) return;

  const VoxelPlanes planes{chunks, held};
  char* const block = planes.block(row);
  const auto old = load_four<FourNarrow>(planes.weight(block) + first);
  bool seen[kTogether], any_seen = false;
  for (int i = 0; i < kTogether; ++i) {
    seen[i] = near[i] || (pixel[i] >= 0 && old.of[i] > 0);
    any_seen |= seen[i];
  }
  if (!any_seen) return;

  float share[kTogether] = {};
  auto tsdf = load_four<FourNarrow>(planes.tsdf(block) + first);
  FourNarrow weights = old;
  for (int i = 0; i < kTogether; ++i) {
    if (!seen[i]) continue;
    const float more = weight == nullptr ? 1.0f : static_cast<float>(weight[pixel[i]]);
    const float sum = static_cast<float>(old.of[i]) + more, before = tsdf.of[i];
    share[i] = more / sum;
    const float distance = scaled[i] < math::kTsdfScale ? scaled[i] : math::kTsdfScale;
    tsdf.of[i] = static_cast<int16_t>(rintf(before + (distance - before) * share[i]));
    weights.of[i] = static_cast<int16_t>(sum < math::kMaxWeight ? sum : math::kMaxWeight);
  }
  store_four(planes.tsdf(block) + first, tsdf);
  store_four(planes.weight(block) + first, weights);

  FourNarrow counts = old;  // without views of their own, weights are counts
  if (planes.has(VoxelPlanes::kViews)) {
    counts = load_four<FourNarrow>(planes.views(block) + first);
    FourNarrow after = counts;
    for (int i = 0; i < kTogether; ++i)
      if (seen[i] && counts.of[i] < 32767) ++after.of[i];
    store_four(planes.views(block) + first, after);
  }
  if (!any_near) return;
  if (planes.has(VoxelPlanes::kColor) && color != nullptr) {
    auto colors = load_four<FourWide>(planes.color(block) + first);
    for (int i = 0; i < kTogether; ++i) {
      if (!near[i]) continue;
      const int32_t turn = math::color_turn<int32_t>(counts.of[i], first + i);
      const int32_t steps = static_cast<int32_t>(rintf(share[i] * 32768.0f));
      colors.of[i] = math::mixed_color<int32_t>(colors.of[i], color[pixel[i]], steps, turn);
    }
    store_four(planes.color(block) + first, colors);
  }
  if (planes.has(VoxelPlanes::kLabel) && label != nullptr) {
    auto labels = load_four<FourWide>(planes.label(block) + first);
    auto votes = load_four<FourNarrow>(planes.votes(block) + first);
    for (int i = 0; i < kTogether; ++i)
      if (near[i]) vote(labels.of[i], votes.of[i], label[pixel[i]]);
    store_four(planes.label(block) + first, labels);
    store_four(planes.votes(block) + first, votes);
  }
}

PC_KERNEL(pc_pack_colors, const uint8_t* colors, int64_t count, int32_t* packed) {
  const int64_t i = thread_index();
  if (i < count) packed[i] = colors[3 * i] << 2 | colors[3 * i + 1] << 12 | colors[3 * i + 2] << 22;
}

}  // namespace pc::gpu
