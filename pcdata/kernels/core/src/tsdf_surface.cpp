// Zero crossings of a truncated signed distance field: the same bits as pcdata/functional/tsdf/surface.py.
#include <limits>

#include "pc/tsdf.hpp"

namespace pc {
namespace {

constexpr int kMarks = 3 * kVoxels / 8;  // bytes per block: a bit per voxel, axis after axis
constexpr int kSide = kEdge + 3;         // voxels -1 .. 9 along each axis of a block with its margin
constexpr int64_t kGrain = 64;           // blocks

struct Field {
  const int64_t *keys, *rows;  // (count,) sorted keys and their rows
  int64_t count;
  VoxelPlanes planes;
};

// The blocks of one column, (x + dx, y + dy, any z), met while walking through the keys in order: what is asked for only
// ever rises, so a cursor that moves up finds it.
class Column {
 public:
  Column(const Field& field, int64_t first, int dx, int dy)
      : field_(field), step_((int64_t{dx} << 42) + (int64_t{dy} << 21)) {
    at_ = std::lower_bound(field.keys, field.keys + field.count, field.keys[first] + step_ - 1) - field.keys;
  }
  // Rows of the blocks at z - 1, z, z + 1; -1 where there is none. No key of a block is next to one across a border of
  // the grid, because the outermost numbers are not used.
  void look(int64_t key, int64_t rows[3]) {
    const int64_t lowest = key + step_ - 1;
    while (at_ < field_.count && field_.keys[at_] < lowest) ++at_;
    int64_t at = at_;
    for (int i = 0; i < 3; ++i) {
      const bool found = at < field_.count && field_.keys[at] == lowest + i;
      rows[i] = found ? field_.rows[at++] : -1;
    }
  }

 private:
  const Field& field_;
  int64_t step_, at_ = 0;
};

// -- marking ------------------------------------------------------------------------------------------------------

// Far from any stored distance: an edge with one unseen end never passes, one with two does not change sign.
constexpr int32_t kUnseen = 1 << 28;
constexpr int kWide = kEdge + 1;

struct Marking {
  int32_t value[kWide * kWide * kWide];

  static int32_t of(const int16_t* tsdf, const int16_t* weight, int i) { return weight[i] > 0 ? tsdf[i] : kUnseen; }

  void fill(const VoxelPlanes& planes, int64_t row, const int64_t after[3]) {
    const int16_t *tsdf = planes.tsdf.block(row), *weight = planes.weight.block(row);
    for (int z = 0; z < kEdge; ++z)
      for (int y = 0; y < kEdge; ++y)
        for (int x = 0; x < kEdge; ++x)
          value[(z * kWide + y) * kWide + x] = of(tsdf, weight, (z * kEdge + y) * kEdge + x);
    for (int axis = 0; axis < 3; ++axis) {
      const int64_t next = after[axis];
      const int16_t* t = next < 0 ? nullptr : planes.tsdf.block(next);
      const int16_t* w = next < 0 ? nullptr : planes.weight.block(next);
      for (int a = 0; a < kEdge; ++a)
        for (int b = 0; b < kEdge; ++b) {
          const int x = axis == 0 ? 0 : a, y = axis == 1 ? 0 : (axis == 0 ? a : b), z = axis == 2 ? 0 : b;
          const int place = ((axis == 2 ? kEdge : z) * kWide + (axis == 1 ? kEdge : y)) * kWide + (axis == 0 ? kEdge : x);
          value[place] = next < 0 ? kUnseen : of(t, w, (z * kEdge + y) * kEdge + x);
        }
    }
  }

  int64_t mark(uint8_t* marks) const {
    constexpr int strides[3] = {1, kWide, kWide * kWide};
    int64_t total = 0;
    for (int axis = 0; axis < 3; ++axis)
      for (int line = 0; line < kEdge * kEdge; ++line) {
        const int32_t* here = value + (line / kEdge * kWide + line % kEdge) * kWide;
        const int32_t* there = here + strides[axis];
        int32_t bits[kEdge];
        for (int x = 0; x < kEdge; ++x) {
          const int32_t apart = here[x] - there[x];
          const int32_t size = apart < 0 ? -apart : apart;
          bits[x] = static_cast<int32_t>((here[x] ^ there[x]) < 0) & static_cast<int32_t>(size <= 32767);
        }
        int packed = 0;
        for (int x = 0; x < kEdge; ++x) packed |= bits[x] << x;
        marks[axis * kEdge * kEdge + line] = static_cast<uint8_t>(packed);
        total += __builtin_popcount(static_cast<unsigned>(packed));
      }
    return total;
  }
};

// -- points -------------------------------------------------------------------------------------------------------

struct Points {
  int64_t* edge;
  float *points, *normals;
  int32_t *weight, *views;
  float* colors;    // or null
  int64_t* labels;  // or null
};

// A block with its margin, unseen voxels NaN, and where to find whatever else its voxels hold.
struct Neighbourhood {
  const VoxelPlanes& planes;
  int64_t rows[27];
  float value[kSide * kSide * kSide];

  static int place(int x, int y, int z) { return ((z + 1) * kSide + (y + 1)) * kSide + (x + 1); }

  void fill() {
    constexpr int from[3] = {-1, 0, kEdge}, to[3] = {0, kEdge, kEdge + 2};
    for (int i = 0; i < 27; ++i) {
      const int sx = i % 3, sy = i / 3 % 3, sz = i / 9;
      const int16_t* tsdf = rows[i] < 0 ? nullptr : planes.tsdf.block(rows[i]);
      const int16_t* weight = rows[i] < 0 ? nullptr : planes.weight.block(rows[i]);
      for (int z = from[sz]; z < to[sz]; ++z)
        for (int y = from[sy]; y < to[sy]; ++y)
          for (int x = from[sx]; x < to[sx]; ++x) {
            const int voxel = ((z & 7) * kEdge + (y & 7)) * kEdge + (x & 7);
            const bool seen = tsdf != nullptr && weight[voxel] > 0;
            value[place(x, y, z)] = seen ? static_cast<float>(tsdf[voxel]) : std::numeric_limits<float>::quiet_NaN();
          }
    }
  }

  // The row and the number of a voxel of the block or of the next ones.
  struct At {
    int64_t row;
    int voxel;
  };
  At at(const int p[3]) const {
    const int block = 13 + (p[0] >> 3) + 3 * (p[1] >> 3) + 9 * (p[2] >> 3);
    return {rows[block], ((p[2] & 7) * kEdge + (p[1] & 7)) * kEdge + (p[0] & 7)};
  }

  float slope(int middle, int stride, int one, int other) const {
    float total = 0, weight = 0;
    for (int i = -1; i <= 1; ++i)
      for (int j = -1; j <= 1; ++j) {
        const int p = middle + (i * one + j * other);
        const float rise = value[p + stride] - value[p - stride];
        const auto share = static_cast<float>((2 - std::abs(i)) * (2 - std::abs(j)));
        const bool seen = rise == rise;
        total += seen ? share * rise : 0.0f;
        weight += seen ? share : 0.0f;
      }
    if (weight > 0) return total / (2 * weight);
    const float here = value[middle], below = value[middle - stride], above = value[middle + stride];
    return (above == above ? above : here) - (below == below ? below : here);
  }
};

void write_point(const Neighbourhood& near, const BlockPlace& block, int64_t number, int voxel, int axis,
                 double voxel_size, const Points& out, int64_t row) {
  constexpr int strides[3] = {1, kSide, kSide * kSide};
  const int first[3] = {voxel % kEdge, voxel / kEdge % kEdge, voxel / (kEdge * kEdge)};
  int second[3] = {first[0], first[1], first[2]};
  ++second[axis];
  const int start = Neighbourhood::place(first[0], first[1], first[2]), end = start + strides[axis];
  const float before = near.value[start], after = near.value[end];
  const float fraction = before / (before - after);
  const int64_t corner[3] = {block.x * kEdge, block.y * kEdge, block.z * kEdge};
  for (int a = 0; a < 3; ++a) {
    auto place = static_cast<double>(corner[a] + first[a]);
    if (a == axis) place += static_cast<double>(fraction);
    out.points[3 * row + a] = static_cast<float>(place * voxel_size);
  }
  const bool is_first = fraction <= 0.5f;
  const int nearer = is_first ? start : end;
  const float gx = near.slope(nearer, strides[0], strides[1], strides[2]);
  const float gy = near.slope(nearer, strides[1], strides[0], strides[2]);
  const float gz = near.slope(nearer, strides[2], strides[0], strides[1]);
  const float length = std::sqrt((gx * gx + gy * gy) + gz * gz);
  float* normal = out.normals + 3 * row;
  const float gradient[3] = {gx, gy, gz};
  for (int a = 0; a < 3; ++a)
    normal[a] = length > 0 ? gradient[a] / length : (a == axis ? (after > before ? 1.0f : -1.0f) : 0.0f);

  const auto one = near.at(first), other = near.at(second);
  const auto least_of = [&](const Plane<int16_t>& plane) {
    return int32_t{std::min(plane.block(one.row)[one.voxel], plane.block(other.row)[other.voxel])};
  };
  out.edge[row] = 3 * (kVoxels * number + voxel) + axis;
  out.weight[row] = least_of(near.planes.weight);
  out.views[row] = near.planes.views ? least_of(near.planes.views) : out.weight[row];
  if (out.colors != nullptr) {
    const int32_t a = near.planes.color.block(one.row)[one.voxel], b = near.planes.color.block(other.row)[other.voxel];
    for (int c = 0; c < 3; ++c) {
      const auto from = static_cast<float>((a >> 10 * c) & 1023), to = static_cast<float>((b >> 10 * c) & 1023);
      out.colors[3 * row + c] = (from + (to - from) * fraction) * static_cast<float>(1.0 / 1020);
    }
  }
  if (out.labels != nullptr) {
    const auto& at = is_first ? one : other;
    out.labels[row] = near.planes.label.block(at.row)[at.voxel];
  }
}

void mark_all(const pc_context& context, const Field& field, uint8_t* marks, int64_t* counts) {
  parallel_for(context, field.count, kGrain, [&](int64_t begin, int64_t end, int64_t) {
    Column own(field, begin, 0, 0), right(field, begin, 1, 0), below(field, begin, 0, 1);
    Marking marking;
    for (int64_t i = begin; i < end; ++i) {
      int64_t along[3], across[3], down[3];
      own.look(field.keys[i], along);
      right.look(field.keys[i], across);
      below.look(field.keys[i], down);
      const int64_t after[3] = {across[1], down[1], along[2]};
      marking.fill(field.planes, field.rows[i], after);
      counts[i] = marking.mark(marks + i * kMarks);
    }
  });
}

void write_all(const pc_context& context, const Field& field, const uint8_t* marks, const int64_t* starts,
               double voxel_size, const Points& out) {
  parallel_for(context, field.count, kGrain, [&](int64_t begin, int64_t end, int64_t) {
    std::vector<Column> columns;
    for (int c = 0; c < 9; ++c) columns.emplace_back(field, begin, c % 3 - 1, c / 3 - 1);
    Neighbourhood near{field.planes, {}, {}};
    for (int64_t i = begin; i < end; ++i) {
      int64_t row = starts[i];
      if (row == starts[i + 1]) continue;
      for (int c = 0; c < 9; ++c) {
        int64_t rows[3];
        columns[static_cast<size_t>(c)].look(field.keys[i], rows);
        for (int z = 0; z < 3; ++z) near.rows[c + 9 * z] = rows[z];
      }
      near.fill();
      const BlockPlace block = BlockPlace::of(field.keys[i]);
      const uint8_t* own = marks + i * kMarks;
      for (int line = 0; line < kEdge * kEdge; ++line) {
        const int any = own[line] | own[line + 64] | own[line + 128];
        for (int left = any; left != 0; left &= left - 1) {
          const int x = __builtin_ctz(static_cast<unsigned>(left));
          for (int axis = 0; axis < 3; ++axis)
            if (own[64 * axis + line] >> x & 1)
              write_point(near, block, i, line * kEdge + x, axis, voxel_size, out, row++);
        }
      }
    }
  });
}

}  // namespace
}  // namespace pc

// Sorted block keys (count,) with their rows; planes as in pc_tsdf_integrate -> marks (count, 192): which edges cross
// zero; counts (count,): how many of each block.
PC_EXPORT int32_t pc_tsdf_mark(const pc_context* context, const int64_t* keys, const int64_t* rows, int64_t count,
                               const int64_t* const* planes, uint8_t* marks, int64_t* counts) {
  return pc::guarded([&] { pc::mark_all(*context, {keys, rows, count, pc::VoxelPlanes(planes)}, marks, counts); });
}

// The same with marks, and starts (count + 1,): where each block's points go -> edge (M,), points (M, 3), normals (M, 3),
// weight (M,), views (M,), colors (M, 3) or null, labels (M,) or null.
PC_EXPORT int32_t pc_tsdf_points(const pc_context* context, const int64_t* keys, const int64_t* rows, int64_t count,
                                 const int64_t* const* planes, const uint8_t* marks, const int64_t* starts,
                                 double voxel_size, int64_t* edge, float* points, float* normals, int32_t* weight,
                                 int32_t* views, float* colors, int64_t* labels) {
  return pc::guarded([&] {
    pc::write_all(*context, {keys, rows, count, pc::VoxelPlanes(planes)}, marks, starts, voxel_size,
                  {edge, points, normals, weight, views, colors, labels});
  });
}
