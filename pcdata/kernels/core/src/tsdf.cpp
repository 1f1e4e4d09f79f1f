// Averaging depth images into a truncated signed distance field.
#include "pc/tsdf.hpp"

#include "pc/radix_sort.hpp"
#include "pc/voxel_table.hpp"

namespace pc {
namespace {

// -- which blocks a view touches ----------------------------------------------------------------------------------

struct TouchingView {
  const float* depth;        // (height, width)
  const double* rays;        // (height, width, 2)
  int64_t height, width;
  const double* pose;        // (3, 4) world from camera
  const double* offsets;     // (num_offsets,) along z
  int64_t num_offsets;
  double per_block;
};

// What the threads compute a row in: all of 64 bits, so that compilers vectorise the loops.
struct Line {
  double *depth, *z, *place[3];
  int64_t* keys;

  Line(ScratchFrame& scratch, int64_t width)
      : depth(scratch.take<double>(width)),
        z(scratch.take<double>(width)),
        place{scratch.take<double>(width), scratch.take<double>(width), scratch.take<double>(width)},
        keys(scratch.take<int64_t>(width)) {}

  void start(const TouchingView& view, int64_t row) {
    for (int64_t u = 0; u < view.width; ++u) depth[u] = static_cast<double>(view.depth[row * view.width + u]);
  }

  // The keys of the row at one offset, -1 without a reading. False if a block lies out of reach.
  bool fill(const TouchingView& view, int64_t row, double offset) {
    const double* rays = view.rays + 2 * row * view.width;
    const int64_t width = view.width;
    for (int64_t u = 0; u < width; ++u) z[u] = depth[u] + offset;
    for (int a = 0; a < 3; ++a) {
      const double *m = view.pose + 4 * a, per_block = view.per_block;
      const double m0 = m[0], m1 = m[1], m2 = m[2], m3 = m[3];
      double* out = place[a];
      for (int64_t u = 0; u < width; ++u)
        out[u] = std::floor(
            (((m0 * (rays[2 * u] * z[u]) + m1 * (rays[2 * u + 1] * z[u])) + m2 * z[u]) + m3) * per_block);
    }
    constexpr auto reach = static_cast<double>(kBlocksPerSide);
    int64_t far = 0;
    for (int64_t u = 0; u < width; ++u) {
      const double x = place[0][u], y = place[1][u], w = place[2][u];
      const bool read = (depth[u] > 0) & (z[u] > 0);
      const bool inside = (std::fabs(x) < reach) & (std::fabs(y) < reach) & (std::fabs(w) < reach);
      const bool good = read & inside;
      far += static_cast<int64_t>(read & !inside);
      const BlockPlace block{static_cast<int64_t>(good ? x : 0.0), static_cast<int64_t>(good ? y : 0.0),
                             static_cast<int64_t>(good ? w : 0.0)};
      keys[u] = good ? block.key() : -1;
    }
    return far == 0;
  }
};

struct KeyItem {
  uint64_t key;
};

// Write the sorted, distinct keys to `found`; return how many, or -1 if a block lies out of reach.
int64_t touched(const pc_context& context, const TouchingView& view, int64_t* found) {
  constexpr int64_t kRows = 8;
  ScratchFrame scratch;
  const int64_t most = view.height * view.width * view.num_offsets;
  const auto threads = static_cast<size_t>(std::max<int32_t>(1, context.threads));
  struct Own {
    PackedVoxel* keys;
    Line line;
    bool used = false;
  };
  std::vector<Own> own;
  std::vector<VoxelTable<PackedVoxel>> tables;
  for (size_t t = 0; t < threads; ++t) {
    tables.emplace_back(scratch, most);
    own.push_back({scratch.take<PackedVoxel>(most), Line(scratch, view.width)});
  }
  std::atomic<bool> far{false};
  parallel_for(context, view.height, kRows, [&](int64_t begin, int64_t end, int64_t thread) {
    Own& mine = own[static_cast<size_t>(thread)];
    VoxelTable<PackedVoxel>& table = tables[static_cast<size_t>(thread)];
    if (!mine.used) table.start(mine.keys);
    mine.used = true;
    for (int64_t row = begin; row < end; ++row) {
      mine.line.start(view, row);
      for (int64_t step = 0; step < view.num_offsets; ++step) {
        if (!mine.line.fill(view, row, view.offsets[step])) far.store(true, std::memory_order_relaxed);
        int64_t last = -1;
        for (int64_t u = 0; u < view.width; ++u)
          if (const int64_t key = mine.line.keys[u]; key != last && key >= 0) {
            table.number({static_cast<uint64_t>(key)});
            last = key;
          }
      }
    }
  });
  if (far) return -1;
  int64_t total = 0;
  for (size_t t = 0; t < threads; ++t) total += own[t].used ? tables[t].count() : 0;
  KeyItem* items = scratch.take<KeyItem>(total);
  KeyItem* spare = scratch.take<KeyItem>(total);
  int64_t count = 0;
  for (size_t t = 0; t < threads; ++t)
    for (int64_t i = 0; own[t].used && i < tables[t].count(); ++i) items[count++] = {own[t].keys[i].bits};
  const KeyItem* sorted = radix_sort(context, scratch, items, spare, even_pieces(context, total), 63);
  count = 0;
  for (int64_t i = 0; i < total; ++i)
    if (i == 0 || sorted[i].key != sorted[i - 1].key) found[count++] = static_cast<int64_t>(sorted[i].key);
  return count;
}

// -- averaging a view into blocks ---------------------------------------------------------------------------------

struct View {
  const float* depth;    // (height, width)
  const int32_t* weight;  // the same; null = 1 everywhere
  const int32_t* color;   // r | g << 8 | b << 16, or null
  const int32_t* label;   // or null
  int64_t height, width;
  const double* pose;    // (3, 4) camera from world
  double block_size;
  const float* steps;    // (3, 512): the voxels of a block from its first one, in the camera's frame
  const float* pinhole;  // fx, skew, cx, fy, cy
  const float* lens;     // 12 coefficients and the squared radius where the model folds, or null
  float scale;           // of a stored distance, per metre
  bool carve;
};

// OpenCV's lens model, in the order of operations of the reference.
inline void bend(const float* c, FloatLanes& x, FloatLanes& y, const FloatLanes& r2) {
  const FloatLanes radial =
      (1 + r2 * (c[0] + r2 * (c[1] + r2 * c[4]))) / (1 + r2 * (c[5] + r2 * (c[6] + r2 * c[7])));
  const FloatLanes xy = (2 * x) * y;
  const FloatLanes bent = ((x * radial + c[2] * xy) + c[3] * (r2 + (2 * x) * x)) + (c[8] + c[9] * r2) * r2;
  y = ((y * radial + c[2] * (r2 + (2 * y) * y)) + c[3] * xy) + (c[10] + c[11] * r2) * r2;
  x = bent;
}

inline FloatLanes channel_of(const IntLanes& packed, int shift, int32_t mask) {
  return as_float((packed >> shift) & mask);
}

// The stored colour with a pixel's averaged in, rounded up or down in turn.
inline IntLanes mixed_color(const IntLanes& old, const IntLanes& pixel, const FloatLanes& share, const IntLanes& count,
                            const IntLanes& voxel) {
  const FloatLanes turn = as_float((count * 159 + voxel * 83) & 255) * (1.0f / 256);
  IntLanes mixed = {};
  for (int channel = 0; channel < 3; ++channel) {
    const FloatLanes before = channel_of(old, 10 * channel, 1023);
    const FloatLanes now = channel_of(pixel, 8 * channel, 255) * 4;
    mixed |= truncated((before + (now - before) * share) + turn) << (10 * channel);
  }
  return mixed;
}

inline void vote(int32_t* label, int16_t* votes, const IntLanes& seen, const IntLanes& near) {
  const IntLanes candidate = load<IntLanes>(label), lead = widened(votes);
  const IntLanes open = lead == 0;
  const IntLanes raised = lead + 1;
  const IntLanes capped = raised > 32767 ? raised - 1 : raised;
  const IntLanes after = ((seen == candidate) | open) ? capped : lead - 1;
  store(label, (near & open) ? seen : candidate);
  store_short(votes, near ? after : lead);
}

template <bool kLens>
void integrate_block(const View& view, int64_t key, const VoxelPlanes& planes, int64_t row) {
  const BlockPlace block = BlockPlace::of(key);
  float corner[3];
  const double bx = static_cast<double>(block.x) * view.block_size;
  const double by = static_cast<double>(block.y) * view.block_size;
  const double bz = static_cast<double>(block.z) * view.block_size;
  for (int a = 0; a < 3; ++a) {
    const double* m = view.pose + 4 * a;
    corner[a] = static_cast<float>(((m[0] * bx + m[1] * by) + m[2] * bz) + m[3]);
  }
  const float fx = view.pinhole[0], skew = view.pinhole[1], cx = view.pinhole[2], fy = view.pinhole[3];
  const float cy = view.pinhole[4], width = static_cast<float>(view.width), height = static_cast<float>(view.height);
  const IntLanes stride = IntLanes{} + static_cast<int32_t>(view.width);
  IntLanes voxel;
  for (int i = 0; i < kLanes; ++i) voxel[i] = i;
  int16_t *tsdf = planes.tsdf.block(row), *weight = planes.weight.block(row);
  for (int at = 0; at < kVoxels; at += kLanes, voxel += kLanes) {
    const FloatLanes z = corner[2] + load<FloatLanes>(view.steps + 2 * kVoxels + at);
    const FloatLanes inverse = 1.0f / z;
    FloatLanes x = (corner[0] + load<FloatLanes>(view.steps + at)) * inverse;
    FloatLanes y = (corner[1] + load<FloatLanes>(view.steps + kVoxels + at)) * inverse;
    IntLanes inside = z > 0;
    if (kLens) {
      const FloatLanes radius = x * x + y * y;
      inside &= radius < view.lens[12];
      bend(view.lens, x, y, radius);
    }
    const FloatLanes u = ((x * fx + y * skew) + cx) + 0.5f, v = (y * fy + cy) + 0.5f;
    inside &= (u >= 0) & (u < width) & (v >= 0) & (v < height);
    if (bits_of_lanes(inside) == 0) continue;
    const FloatLanes zero = {};
    const IntLanes pixel = truncated(inside ? v : zero) * stride + truncated(inside ? u : zero);
    const FloatLanes reading = gather(view.depth, pixel);
    const FloatLanes scaled = (reading - z) * view.scale;
    inside &= reading > 0;
    const IntLanes near = inside & (scaled <= kTsdfScale) & (scaled >= -kTsdfScale);
    IntLanes seen = near;
    if (view.carve) seen |= inside & (scaled > kTsdfScale) & (widened(weight + at) > 0);
    if (bits_of_lanes(seen) == 0) continue;

    const IntLanes old_count = widened(weight + at);
    const FloatLanes old = as_float(old_count);
    const FloatLanes more = view.weight == nullptr ? zero + 1.0f : as_float(gather(view.weight, pixel));
    const FloatLanes sum = old + more;
    const FloatLanes share = more / sum;
    const FloatLanes before = as_float(widened(tsdf + at));
    const FloatLanes most = zero + kTsdfScale;
    const FloatLanes average = rounded(before + (least(scaled, most) - before) * share);
    store_short(tsdf + at, truncated(seen ? average : before));
    store_short(weight + at, truncated(seen ? least(sum, zero + kMaxWeight) : old));
    int16_t* views = planes.views ? planes.views.block(row) + at : nullptr;
    const IntLanes count = views == nullptr ? old_count : widened(views);
    if (planes.color && view.color != nullptr) {
      int32_t* color = planes.color.block(row) + at;
      const IntLanes stored = load<IntLanes>(color);
      const IntLanes mixed = mixed_color(stored, gather(view.color, pixel), share, count, voxel);
      store(color, near ? mixed : stored);
    }
    if (planes.label && view.label != nullptr)
      vote(planes.label.block(row) + at, planes.votes.block(row) + at, gather(view.label, pixel), near);
    if (views != nullptr) store_short(views, (near & (count < 32767)) ? count + 1 : count);
  }
}

}  // namespace
}  // namespace pc

// depth (height, width), rays (height, width, 2), pose (3, 4) world from camera, offsets (num_offsets,) -> the sorted
// keys of the touched blocks, found (*count,), of room for every reading at every offset. *count becomes -1 if a block
// lies out of reach.
PC_EXPORT int32_t pc_tsdf_touched(const pc_context* context, const float* depth, const double* rays, int64_t height,
                                  int64_t width, const double* pose, const double* offsets, int64_t num_offsets,
                                  double per_block, int64_t* found, int64_t* count) {
  return pc::guarded([&] {
    *count = pc::touched(*context, {depth, rays, height, width, pose, offsets, num_offsets, per_block}, found);
  });
}

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
    constexpr int64_t kGrain = 32;
    pc::parallel_for(*context, num_rows, kGrain, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i) {
        if (lens == nullptr)
          pc::integrate_block<false>(view, keys[rows[i]], voxels, rows[i]);
        else
          pc::integrate_block<true>(view, keys[rows[i]], voxels, rows[i]);
      }
    });
  });
}
