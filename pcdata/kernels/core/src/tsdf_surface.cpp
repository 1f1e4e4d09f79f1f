// Zero crossings of a truncated signed distance field: the same numbers as pcdata/functional/tsdf/surface.py, the normals
// up to the last bit of a square root.
#include "pc/tsdf_walk.hpp"

namespace pc {
namespace {

constexpr int64_t kGrain = 64;                  // blocks
constexpr int kSlab = kEdge * kEdge;            // voxels of one z
constexpr int16_t kUnseen = -32768;             // no stored distance: those end at -32767
constexpr int kMost = 3 * kVoxels + 16;         // edges of a block, and a line so that columns do not share cache sets
constexpr int kVoxelStep[3] = {1, kEdge, kSlab}, kShift[3] = {0, 3, 6};  // of the coordinates in a voxel's number

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
  void copy_line(int voxel, int16_t* to, int16_t bound) const {
    const auto seen = load<Line>(weight + voxel) > bound;
    store(to, (load<Line>(tsdf + voxel) & seen) | (kUnseen & ~seen));
  }
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

  // Apart in sign, by at most 32767: 16 bits hold the difference. An unseen end is too far from one that is not negative.
  static uint64_t crossing(const int16_t* here, const int16_t* there) {
    int8_t truth[kSlab];
    for (int i = 0; i < kSlab; ++i) {
      const int16_t low = std::min(here[i], there[i]), high = std::max(here[i], there[i]);
      const auto apart = static_cast<int16_t>(high - low);
      truth[i] = static_cast<int8_t>((low & ~high & ~apart) >> 15);
    }
    return signs_of(truth);
  }

  int16_t value_[kPitch * (kEdge + 1)];
};

void count_all(const pc_context& context, const Field& field, int16_t bound, int64_t* counts, int64_t* dropped) {
  std::atomic<int64_t> all_dropped{0};
  parallel_for(context, field.blocks.count, kGrain, [&](int64_t begin, int64_t end, int64_t) {
    Column own(field.blocks, begin, 0, 0), right(field.blocks, begin, 1, 0), below(field.blocks, begin, 0, 1);
    EdgeEnds ends;
    int64_t lost = 0;
    for (int64_t i = begin; i < end; ++i) {
      int64_t along[3], across[3], down[3];
      own.look(field.blocks.keys[i], along);
      right.look(field.blocks.keys[i], across);
      below.look(field.blocks.keys[i], down);
      const Distances near[4] = {Distances::of(field, i), Distances::of(field, across[1]),
                                 Distances::of(field, down[1]), Distances::of(field, along[2])};
      counts[i] = ends.marks(near[0], near[1], near[2], near[3], bound).count();
      if (bound > 0) lost += ends.marks(near[0], near[1], near[2], near[3], 0).count() - counts[i];
    }
    all_dropped.fetch_add(lost, std::memory_order_relaxed);
  });
  *dropped = all_dropped.load();
}

// -- slopes -------------------------------------------------------------------------------------------------------

// A block with two voxels of what is around it, in lines of 16: voxels -2 .. 10 along each axis, and more along x.
constexpr int kSide = kEdge + 5, kLine = 16;
constexpr int kStride[3] = {1, kLine, kSide * kLine};
constexpr int kPlaces = kSide * kSide * kLine;

constexpr int place_of(int x, int y, int z) { return ((z + 2) * kSide + (y + 2)) * kLine + (x + 2); }

// Lines of the block with its margin, both ends within.
struct Range {
  int y0, y1, z0, z1;

  Range wider(int y, int z) const { return {y0 - y, y1 + y, z0 - z, z1 + z}; }
  // Call body(first place, last place + 1) for every z: lines follow one another.
  template <class Body>
  void each(const Body& body) const {
    for (int z = z0; z <= z1; ++z) body(place_of(-2, y0, z), place_of(-2, y1 + 1, z));
  }
  // The lines on which the ends of marked edges lie.
  static Range of(const Marks& marks) {
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

class Neighbourhood {
 public:
  void fill(const Distances near[27], const Range& lines) {
    for (int z = lines.z0; z <= lines.z1; ++z)
      for (int y = lines.y0; y <= lines.y1; ++y) {
        const Distances* three = near + 13 + 3 * (y >> 3) + 9 * (z >> 3);
        const int line = (z & 7) * kSlab + (y & 7) * kEdge;
        int16_t* to = value_ + kBefore + place_of(0, y, z);
        // In this order: what runs over the end of a line is overwritten by the next.
        to[-2] = three[-1].at(line + kEdge - 2, 0);
        to[-1] = three[-1].at(line + kEdge - 1, 0);
        three[0].copy_line(line, to, 0);
        three[1].copy_line(line, to + kEdge, 0);
      }
  }

  // For every voxel on these lines and every axis, the sum of the rises between the voxels one and two steps on either
  // side, weighted 4, 2, 1 from the middle to the corners of the 3 x 3 lines along the axis; and 2^24 times the sum of
  // the steps, weighted likewise. A pair with an unseen end does not count. Both sums fit one number: the steps' is at
  // most 16 * (1 + 2) = 48, the rises' size at most 16 * 2 * 65534 < 2^23.
  void find_slopes(const Range& lines) {
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

  // The rise to the one neighbour that was seen, twice if there are two, none if there is none.
  float rise_to_seen(int place, int axis) const {
    const int16_t here = value(place), below = value(place - kStride[axis]), above = value(place + kStride[axis]);
    return static_cast<float>((above == kUnseen ? here : above) - (below == kUnseen ? here : below));
  }

 private:
  static constexpr int kBefore = 16;  // room that loops over whole lines may read, its content goes nowhere
  static constexpr int kRoom = kBefore + kPlaces + 2 * kLine;

  void pair_up(int stride, const Range& lines) {
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
  static void smooth(const int32_t* from, int stride, int32_t* to, const Range& lines) {
    lines.each([&](int begin, int end) {
      for (int i = kBefore + begin; i < kBefore + end; ++i) to[i] = from[i - stride] + 2 * from[i] + from[i + stride];
    });
  }

  alignas(64) int16_t value_[kRoom] = {};
  alignas(64) int32_t pairs_[kRoom] = {}, half_[kRoom] = {}, slopes_[3][kRoom] = {};
};

// -- points -------------------------------------------------------------------------------------------------------

struct Points {
  int64_t* edge;  // or null
  float *points, *normals, *weight;
  int64_t* views;
  float* colors;    // or null
  int64_t* labels;  // or null
};

// One plane of a block and of the next ones along x, y and z, to read at both ends of an edge.
template <class T>
struct PlaneAround {
  const T* of[4];

  PlaneAround(const Plane<T>& plane, const SortedBlocks& blocks, const int64_t places[27]) {
    constexpr int around[4] = {13, 14, 16, 22};
    for (int i = 0; i < 4; ++i)
      of[i] = places[around[i]] < 0 ? nullptr : plane.block(blocks.rows[places[around[i]]]);
  }
};

// The crossings of one block, column by column, so that compilers vectorise the arithmetic.
struct Crossings {
  int count;
  int32_t voxel[kMost], axis[kMost], start[kMost];
  int32_t end_block[kMost], end_voxel[kMost];  // of the second end: 0 is the block itself, 1 + axis the next
  float before[kMost], after[kMost], fraction[kMost], place[kMost];
  int32_t corner[kMost];  // coordinate of the first end, in voxels, along the axis
  int32_t first[3][kMost], second[3][kMost];
  float gradient[3][kMost], length[kMost];
  int32_t packed[2][kMost];
  float channel[3][kMost];

  void list(const Marks& marks) {
    count = 0;
    for (int z = 0; z < kEdge; ++z)
      for (uint64_t left = marks.any(z); left != 0; left &= left - 1) {
        const int inner = __builtin_ctzll(left);
        for (int a = 0; a < 3; ++a) {
          voxel[count] = kSlab * z + inner;
          axis[count] = a;
          count += static_cast<int>(marks.along[z][a] >> inner & 1);
        }
      }
  }

  void read(const Neighbourhood& near, const BlockPlace& block) {
    const auto x = static_cast<int32_t>(block.x * kEdge), y = static_cast<int32_t>(block.y * kEdge),
               z = static_cast<int32_t>(block.z * kEdge);
    const int32_t corners[3] = {x, y, z};
    for (int i = 0; i < count; ++i) {
      const int v = voxel[i], a = axis[i];
      start[i] = place_of(v & 7, v >> 3 & 7, v >> 6);
      const int end = start[i] + kStride[a];
      before[i] = static_cast<float>(near.value(start[i]));
      after[i] = static_cast<float>(near.value(end));
      const int inner = v >> kShift[a] & 7;
      corner[i] = corners[a] + inner;
      end_block[i] = inner == kEdge - 1 ? 1 + a : 0;
      end_voxel[i] = v + (inner == kEdge - 1 ? -(kEdge - 1) : 1) * kVoxelStep[a];
      for (int b = 0; b < 3; ++b) {
        first[b][i] = near.slope(b, start[i]);
        second[b][i] = near.slope(b, end);
      }
    }
  }

  void locate(double voxel_size) {
    for (int i = 0; i < count; ++i) {
      fraction[i] = before[i] / (before[i] - after[i]);
      const double along = static_cast<double>(corner[i]) + static_cast<double>(fraction[i]);
      place[i] = static_cast<float>(along * voxel_size);
    }
  }

  // Interpolated between both ends, each as much as it has seen.
  void find_gradients(const Neighbourhood& near) {
    for (int a = 0; a < 3; ++a) {
      int32_t unseen = 0;
      for (int i = 0; i < count; ++i) {
        const int32_t rise0 = rise_in(first[a][i]), rise1 = rise_in(second[a][i]);
        const auto steps0 = static_cast<float>((first[a][i] - rise0) >> 24);
        const auto steps1 = static_cast<float>((second[a][i] - rise1) >> 24);
        const float rise = static_cast<float>(rise0) + static_cast<float>(rise1 - rise0) * fraction[i];
        const float steps = steps0 + (steps1 - steps0) * fraction[i];
        gradient[a][i] = rise / (2 * steps);  // not a number without a pair
        unseen |= static_cast<int32_t>(!(steps > 0));
      }
      if (unseen != 0)
        for (int i = 0; i < count; ++i)
          if (gradient[a][i] != gradient[a][i])
            gradient[a][i] = near.rise_to_seen(fraction[i] <= 0.5f ? start[i] : start[i] + kStride[axis[i]], a);
    }
    for (int i = 0; i < count; ++i) {
      const float x = gradient[0][i], y = gradient[1][i], z = gradient[2][i];
      length[i] = std::sqrt((x * x + y * y) + z * z);
    }
    for (int a = 0; a < 3; ++a)
      for (int i = 0; i < count; ++i) gradient[a][i] /= length[i];
  }
  static int32_t rise_in(int32_t both) { return static_cast<int32_t>(static_cast<uint32_t>(both) << 8) >> 8; }

  template <class T>
  T first_of(const PlaneAround<T>& plane, int i) const {
    return plane.of[0][voxel[i]];
  }
  template <class T>
  T second_of(const PlaneAround<T>& plane, int i) const {
    return plane.of[end_block[i]][end_voxel[i]];
  }
  template <class T>
  T least_of(const PlaneAround<T>& plane, int i) const {
    return std::min(first_of(plane, i), second_of(plane, i));
  }

  void mix_colors(const PlaneAround<int32_t>& color) {
    for (int i = 0; i < count; ++i) {
      packed[0][i] = first_of(color, i);
      packed[1][i] = second_of(color, i);
    }
    for (int c = 0; c < 3; ++c)
      for (int i = 0; i < count; ++i) {
        const auto from = static_cast<float>((packed[0][i] >> 10 * c) & 1023);
        const auto to = static_cast<float>((packed[1][i] >> 10 * c) & 1023);
        channel[c][i] = (from + (to - from) * fraction[i]) * static_cast<float>(1.0 / 1020);
      }
  }

  void write(const BlockPlace& block, double voxel_size, float* points, float* normals) const {
    float grid[3][kEdge];
    const int64_t corners[3] = {block.x * kEdge, block.y * kEdge, block.z * kEdge};
    for (int a = 0; a < 3; ++a)
      for (int j = 0; j < kEdge; ++j)
        grid[a][j] = static_cast<float>(static_cast<double>(corners[a] + j) * voxel_size);
    for (int i = 0; i < count; ++i) {
      float* point = points + 3 * i;
      for (int a = 0; a < 3; ++a) point[a] = grid[a][voxel[i] >> kShift[a] & 7];
      point[axis[i]] = place[i];
      float* normal = normals + 3 * i;
      for (int a = 0; a < 3; ++a) normal[a] = gradient[a][i];
      if (!(length[i] > 0)) {
        for (int a = 0; a < 3; ++a) normal[a] = 0;
        normal[axis[i]] = after[i] > before[i] ? 1.0f : -1.0f;
      }
    }
  }
};

void write_block(const Field& field, int64_t number, const int64_t places[27], const Neighbourhood& near,
                 double voxel_size, Crossings& found, const Points& out, int64_t row) {
  const BlockPlace block = BlockPlace::of(field.blocks.keys[number]);
  found.read(near, block);
  found.locate(voxel_size);
  found.find_gradients(near);
  found.write(block, voxel_size, out.points + 3 * row, out.normals + 3 * row);
  const PlaneAround<int16_t> weight(field.planes.weight, field.blocks, places);
  const PlaneAround<int16_t> views(field.planes.views ? field.planes.views : field.planes.weight, field.blocks, places);
  for (int i = 0; i < found.count; ++i) {
    out.weight[row + i] = static_cast<float>(found.least_of(weight, i));
    out.views[row + i] = found.least_of(views, i);
  }
  if (out.edge != nullptr)
    for (int i = 0; i < found.count; ++i) out.edge[row + i] = 3 * (kVoxels * number + found.voxel[i]) + found.axis[i];
  if (out.colors != nullptr) {
    found.mix_colors({field.planes.color, field.blocks, places});
    for (int i = 0; i < found.count; ++i)
      for (int c = 0; c < 3; ++c) out.colors[3 * (row + i) + c] = found.channel[c][i];
  }
  if (out.labels != nullptr) {
    const PlaneAround<int32_t> label(field.planes.label, field.blocks, places);
    for (int i = 0; i < found.count; ++i)
      out.labels[row + i] = found.fraction[i] <= 0.5f ? found.first_of(label, i) : found.second_of(label, i);
  }
}

template <class T>
void fetch(const T* block) {
  for (size_t at = 0; at < kVoxels * sizeof(T); at += 64) __builtin_prefetch(reinterpret_cast<const char*>(block) + at);
}

// Start loading what will be read of the next block: the rest is around the blocks before it.
void fetch(const Field& field, const int64_t places[27], bool colors) {
  for (const int64_t place : {places[13], places[14]}) {
    const Distances distances = Distances::of(field, place);
    fetch(distances.tsdf);
    fetch(distances.weight);
  }
  if (colors) fetch(field.planes.color.block(field.blocks.rows[places[13]]));
}

void write_all(const pc_context& context, const Field& field, int16_t bound, const int64_t* starts, double voxel_size,
               const Points& out) {
  parallel_for(context, field.blocks.count, kGrain, [&](int64_t begin, int64_t end, int64_t) {
    Surroundings around(field.blocks, begin);
    EdgeEnds ends;
    auto near = std::make_unique<Neighbourhood>();
    const std::unique_ptr<Crossings> found(new Crossings);
    const auto next_from = [&](int64_t i) {
      while (i < end && starts[i] == starts[i + 1]) ++i;
      return i;
    };
    int64_t ahead[27];
    int64_t next = next_from(begin);
    if (next < end) around.look(field.blocks.keys[next], ahead);
    while (next < end) {
      const int64_t i = next;
      int64_t places[27];
      Distances distances[27];
      std::memcpy(places, ahead, sizeof places);
      for (int b = 0; b < 27; ++b) distances[b] = Distances::of(field, places[b]);
      next = next_from(i + 1);
      if (next < end) {
        around.look(field.blocks.keys[next], ahead);
        fetch(field, ahead, out.colors != nullptr);
      }
      const Marks marks = ends.marks(distances[13], distances[14], distances[16], distances[22], bound);
      const Range lines = Range::of(marks);
      near->fill(distances, lines.wider(2, 2));
      near->find_slopes(lines);
      found->list(marks);
      write_block(field, i, places, *near, voxel_size, *found, out, starts[i]);
    }
  });
}

}  // namespace
}  // namespace pc

// Sorted block keys (count,) with their rows; planes as in pc_tsdf_integrate; what the weights of both ends must exceed -> counts
// (count,): how many edges of each block cross zero; dropped (1,): how many more do whose ends were seen less.
PC_EXPORT int32_t pc_tsdf_count_crossings(const pc_context* context, const int64_t* keys, const int64_t* rows,
                                          int64_t count, const int64_t* const* planes, int64_t bound, int64_t* counts,
                                          int64_t* dropped) {
  return pc::guarded([&] {
    const pc::Field field{{keys, rows, count}, pc::VoxelPlanes(planes)};
    pc::count_all(*context, field, static_cast<int16_t>(bound), counts, dropped);
  });
}

// The same with starts (count + 1,): where each block's points go -> edge (M,) or null, points (M, 3), normals (M, 3),
// weight (M,), views (M,), colors (M, 3) or null, labels (M,) or null.
PC_EXPORT int32_t pc_tsdf_write_crossings(const pc_context* context, const int64_t* keys, const int64_t* rows,
                                          int64_t count, const int64_t* const* planes, int64_t bound,
                                          const int64_t* starts, double voxel_size, int64_t* edge, float* points,
                                          float* normals, float* weight, int64_t* views, float* colors,
                                          int64_t* labels) {
  return pc::guarded([&] {
    const pc::Field field{{keys, rows, count}, pc::VoxelPlanes(planes)};
    pc::write_all(*context, field, static_cast<int16_t>(bound), starts, voxel_size,
                  {edge, points, normals, weight, views, colors, labels});
  });
}
