// Voxel down-sampling, and counting voxels.
#include <numeric>
#include <optional>

#include "pc/lanes.hpp"
#include "pc/voxels/table.hpp"

namespace pc {
namespace {

// Rows that one thread numbers by itself before the numbers are brought together: few enough that the table of a
// coherent piece fits the L2 cache, and that Ctrl-C is answered after some milliseconds.
constexpr int64_t kPiece = 1 << 17;
// Beyond this, float64 no longer tells neighbouring voxels apart.
constexpr double kMaxVoxelsPerAxis = 9007199254740992.0;  // 2^53
// The trick that turns doubles into integers holds below 2^51.
constexpr int kMaxPackedBits = 50;

// A run of rows of one cloud, and what was found in it.
struct Piece {
  int64_t cloud, begin, end;
  int64_t num_voxels = 0;
};

// All clouds cut into pieces; pieces of cloud c are [first_of[c], first_of[c + 1]).
struct Pieces {
  std::vector<Piece> all;
  std::vector<int64_t> first_of;

  Pieces(const int64_t* ptr, int64_t num_clouds) {
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud) {
      first_of.push_back(size());
      for (int64_t row = ptr[cloud]; row < ptr[cloud + 1]; row += kPiece)
        all.push_back({cloud, row, std::min(ptr[cloud + 1], row + kPiece)});
    }
    first_of.push_back(size());
  }
  int64_t size() const { return static_cast<int64_t>(all.size()); }
  Piece& operator[](int64_t i) { return all[static_cast<size_t>(i)]; }
  int64_t first(int64_t cloud) const { return first_of[static_cast<size_t>(cloud)]; }
};

struct Bounds {
  float low[3], high[3];

  void include(int64_t axis, float lower, float upper) {
    low[axis] = std::min(low[axis], lower);
    high[axis] = std::max(high[axis], upper);
  }
};

// As many points as a register has lanes fill three, whose lanes hold x, y, z, x, ... in turn.
Bounds bounds_of(const float* points, int64_t begin, int64_t end) {
  const float* values = points + 3 * begin;
  const int64_t count = 3 * (end - begin);
  float low[3 * kLanes], high[3 * kLanes];
  for (int i = 0; i < 3 * kLanes; ++i) low[i] = high[i] = values[i % 3];
  FloatLanes lows[3], highs[3];
  std::memcpy(lows, low, sizeof lows);
  std::memcpy(highs, high, sizeof highs);
  int64_t i = 0;
  for (; i + 3 * kLanes <= count; i += 3 * kLanes) {
    for (int part = 0; part < 3; ++part) {
      const FloatLanes some = load<FloatLanes>(values + i + part * kLanes);
      lows[part] = least(some, lows[part]);
      highs[part] = greatest(some, highs[part]);
    }
  }
  std::memcpy(low, lows, sizeof lows);
  std::memcpy(high, highs, sizeof highs);
  Bounds bounds{{low[0], low[1], low[2]}, {high[0], high[1], high[2]}};
  for (int k = 3; k < 3 * kLanes; ++k) bounds.include(k % 3, low[k], high[k]);
  for (; i < count; ++i) bounds.include(i % 3, values[i], values[i]);
  return bounds;
}

// False if the cloud spans 2^53 voxels or more.
bool measure(const Bounds& bounds, double size, VoxelGrid& grid) {
  grid.size = size;
  for (int axis = 0; axis < 3; ++axis) {
    grid.origin[axis] = static_cast<double>(bounds.low[axis]) - size / 2;
    const double last = std::floor((static_cast<double>(bounds.high[axis]) - grid.origin[axis]) / size);
    if (!(last < kMaxVoxelsPerAxis)) return false;
    grid.bits[axis] = 0;
    while (std::ldexp(1.0, grid.bits[axis]) <= last) ++grid.bits[axis];
    if (grid.bits[axis] > kMaxPackedBits) grid.bits[axis] = 64;
  }
  return true;
}

// The grid of every cloud; false if one spans too many voxels.
bool measure_all(const pc_context& context, ScratchFrame& scratch, const float* points, Pieces& pieces,
                 const double* sizes, int64_t num_clouds, VoxelGrid* grids) {
  Bounds* bounds = scratch.take<Bounds>(pieces.size());
  parallel_for(context, pieces.size(), 1,
               [&](int64_t p, int64_t, int64_t) { bounds[p] = bounds_of(points, pieces[p].begin, pieces[p].end); });
  for (int64_t cloud = 0; cloud < num_clouds; ++cloud) {
    const int64_t first = pieces.first(cloud), last = pieces.first(cloud + 1);
    if (first == last) continue;
    Bounds all = bounds[first];
    for (int64_t p = first + 1; p < last; ++p)
      for (int axis = 0; axis < 3; ++axis) all.include(axis, bounds[p].low[axis], bounds[p].high[axis]);
    if (!measure(all, sizes[cloud], grids[cloud])) return false;
  }
  return true;
}

// Where the pieces leave their results: piece p owns [begin, end) of each, like its rows, and uses what it needs.
template <class Voxel>
struct Found {
  Voxel* voxels;     // by number
  VoxelSum* sums;    // by number; null if nobody asks
  int32_t* common;   // the number of a piece's voxel in its cloud, by its number in the piece
};

// Number the voxels of one piece by first appearance and sum the offsets of their points.
template <class Voxel>
void number_piece(const float* points, Piece& piece, const VoxelGrid& grid, VoxelTable<Voxel>& table,
                  const Found<Voxel>& found, int64_t* numbers) {
  VoxelBlock block;
  Voxel voxels[VoxelBlock::kSize];
  VoxelSum* sums = found.sums + piece.begin;
  table.start(found.voxels + piece.begin);
  // Neighbouring rows often share a voxel: a run of them is summed in registers.
  Voxel current{};
  int32_t number = -1;
  VoxelSum run{};
  for (int64_t begin = piece.begin; begin < piece.end; begin += VoxelBlock::kSize) {
    const auto count = static_cast<int>(std::min<int64_t>(piece.end - begin, VoxelBlock::kSize));
    block.place(points + 3 * begin, count, grid);
    block.keys(count, grid, voxels);
    for (int i = 0; i < count; ++i) table.prefetch(voxels[i]);
    for (int i = 0; i < count; ++i) {
      if (number < 0 || !(voxels[i] == current)) {
        if (number >= 0) sums[number].add(run);
        run = {};
        current = voxels[i];
        const int64_t known = table.count();
        number = table.number(current);
        if (table.count() > known) sums[number] = {};
      }
      run.add(block.offset(0, i), block.offset(1, i), block.offset(2, i));
      numbers[begin + i] = number;
    }
  }
  sums[number].add(run);
  piece.num_voxels = table.count();
}

// The same where only the voxels matter.
template <class Voxel>
void list_piece(const float* points, Piece& piece, const VoxelGrid& grid, VoxelTable<Voxel>& table,
                const Found<Voxel>& found) {
  VoxelBlock block;
  Voxel voxels[VoxelBlock::kSize];
  table.start(found.voxels + piece.begin);
  for (int64_t begin = piece.begin; begin < piece.end; begin += VoxelBlock::kSize) {
    const auto count = static_cast<int>(std::min<int64_t>(piece.end - begin, VoxelBlock::kSize));
    block.place(points + 3 * begin, count, grid);
    block.keys(count, grid, voxels);
    for (int i = 0; i < count; ++i) table.prefetch(voxels[i]);
    for (int i = 0; i < count; ++i)
      if (i == 0 || !(voxels[i] == voxels[i - 1])) table.number(voxels[i]);
  }
  piece.num_voxels = table.count();
}

// Give the voxels of one cloud's pieces common numbers, from 0 on; return how many there are. Pieces follow one another
// in rows, so these too are in the order of first appearance. Sums of one voxel come together. All in place: a common
// number is never above the count of voxels read before, so nothing is overwritten unread.
template <class Voxel>
int64_t merge(const Piece* first, const Piece* last, VoxelTable<Voxel>& table, const Found<Voxel>& found) {
  constexpr int64_t kAhead = 16;  // lookups under way at once, against the latency of the L3 cache
  table.start(found.voxels + first->begin);
  for (const Piece* piece = first; piece < last; ++piece) {
    const int64_t end = piece->begin + piece->num_voxels;
    for (int64_t i = piece->begin; i < end; ++i) {
      if (i + kAhead < end) table.prefetch(found.voxels[i + kAhead]);
      const int64_t known = table.count();
      const int32_t number = table.number(Voxel(found.voxels[i]));
      found.common[i] = number;
      if (found.sums == nullptr) continue;
      VoxelSum& sum = found.sums[first->begin + number];
      const VoxelSum more = found.sums[i];
      if (table.count() > known)
        sum = more;
      else
        sum.add(more);
    }
  }
  return table.count();
}

// Merge the pieces of every cloud; counts[c] becomes the number of its voxels.
template <class Voxel>
void merge_all(ScratchFrame& scratch, Pieces& pieces, int64_t num_clouds, const Found<Voxel>& found, int64_t* counts) {
  for (int64_t cloud = 0; cloud < num_clouds; ++cloud) {
    const int64_t first = pieces.first(cloud), last = pieces.first(cloud + 1);
    if (first == last) {
      counts[cloud] = 0;
    } else if (last - first == 1) {
      counts[cloud] = pieces[first].num_voxels;
      std::iota(found.common + pieces[first].begin, found.common + pieces[first].begin + counts[cloud], 0);
    } else {
      int64_t most = 0;
      for (int64_t p = first; p < last; ++p) most += pieces[p].num_voxels;
      VoxelTable<Voxel> table(scratch, most);
      counts[cloud] = merge(&pieces[first], &pieces[first] + (last - first), table, found);
    }
  }
}

template <class Voxel>
Found<Voxel> room_for(ScratchFrame& scratch, int64_t rows, bool sums) {
  return {scratch.take<Voxel>(rows), sums ? scratch.take<VoxelSum>(rows) : nullptr, scratch.take<int32_t>(rows)};
}

template <class Voxel>
std::vector<VoxelTable<Voxel>> tables_for(const pc_context& context, ScratchFrame& scratch, const Pieces& pieces) {
  int64_t longest = 0;
  for (const Piece& piece : pieces.all) longest = std::max(longest, piece.end - piece.begin);
  std::vector<VoxelTable<Voxel>> tables;
  for (int64_t t = 0; t < std::max<int64_t>(1, std::min<int64_t>(context.threads, pieces.size())); ++t)
    tables.emplace_back(scratch, longest);
  return tables;
}

// What a call to downsample() reads and writes.
struct Clouds {
  const float* points;  // (rows, 3)
  const int64_t* ptr;
  int64_t num_clouds;
  const double* sizes;
};

template <class Voxel>
void downsample(const pc_context& context, ScratchFrame& scratch, const Clouds& clouds, Pieces& pieces,
                const VoxelGrid* grids, float* means, int64_t* inverse, int64_t* counts) {
  const Found<Voxel> found = room_for<Voxel>(scratch, clouds.ptr[clouds.num_clouds], true);
  auto tables = tables_for<Voxel>(context, scratch, pieces);
  parallel_for(context, pieces.size(), 1, [&](int64_t p, int64_t, int64_t thread) {
    number_piece(clouds.points, pieces[p], grids[pieces[p].cloud], tables[static_cast<size_t>(thread)], found, inverse);
  });
  merge_all(scratch, pieces, clouds.num_clouds, found, counts);

  std::vector<int64_t> starts(static_cast<size_t>(clouds.num_clouds) + 1, 0);
  std::partial_sum(counts, counts + clouds.num_clouds, starts.begin() + 1);
  parallel_for(context, pieces.size(), 1, [&](int64_t p, int64_t, int64_t) {
    const Piece& piece = pieces[p];
    const int64_t start = starts[static_cast<size_t>(piece.cloud)];
    for (int64_t row = piece.begin; row < piece.end; ++row)
      inverse[row] = start + found.common[piece.begin + inverse[row]];
  });
  // The voxels of a cloud lie at the start of its rows; cut them like the rows, there are never more.
  parallel_for(context, pieces.size(), 1, [&](int64_t p, int64_t, int64_t) {
    const Piece& piece = pieces[p];
    const int64_t base = clouds.ptr[piece.cloud];
    const int64_t end = std::min(piece.end, base + counts[piece.cloud]);
    float* own = means + 3 * starts[static_cast<size_t>(piece.cloud)];
    for (int64_t i = piece.begin; i < end; ++i)
      mean_of(found.voxels[i], found.sums[i], grids[piece.cloud], own + 3 * (i - base));
  });
}

template <class Voxel>
void count(const pc_context& context, ScratchFrame& scratch, const Clouds& clouds, Pieces& pieces,
           const VoxelGrid* grids, int64_t* counts) {
  const Found<Voxel> found = room_for<Voxel>(scratch, clouds.ptr[clouds.num_clouds], false);
  auto tables = tables_for<Voxel>(context, scratch, pieces);
  parallel_for(context, pieces.size(), 1, [&](int64_t p, int64_t, int64_t thread) {
    list_piece(clouds.points, pieces[p], grids[pieces[p].cloud], tables[static_cast<size_t>(thread)], found);
  });
  merge_all(scratch, pieces, clouds.num_clouds, found, counts);
}

// Call body(a voxel of the type that the clouds need); false if one spans too many voxels.
template <class Body>
bool with_grids(const pc_context& context, ScratchFrame& scratch, const Clouds& clouds, Pieces& pieces, Body&& body) {
  std::vector<VoxelGrid> grids(static_cast<size_t>(clouds.num_clouds));
  for (VoxelGrid& grid : grids) grid = {};
  if (!measure_all(context, scratch, clouds.points, pieces, clouds.sizes, clouds.num_clouds, grids.data()))
    return false;
  if (std::all_of(grids.begin(), grids.end(), [](const VoxelGrid& grid) { return grid.packs(); }))
    body(PackedVoxel{}, grids.data());
  else
    body(WideVoxel{}, grids.data());
  return true;
}

// Number the distinct points of one cloud; -0 equals 0.
int64_t count_distinct(const pc_context& context, const float* points, int64_t count) {
  ScratchFrame scratch;
  Poll poll(context);
  VoxelTable<WideVoxel> table(scratch, count);
  table.start(scratch.take<WideVoxel>(count));
  auto bits = [](float value) {
    int32_t result;
    value += 0.0f;  // -0 becomes 0
    std::memcpy(&result, &value, sizeof result);
    return int64_t{result};
  };
  for (int64_t i = 0; i < count; ++i) {
    if (i % kPiece == 0) poll.check();
    table.number({bits(points[3 * i]), bits(points[3 * i + 1]), bits(points[3 * i + 2])});
  }
  return table.count();
}

// -- the size that leaves a number of voxels ----------------------------------------------------------------------

// Bisect, with the float64 operations of the reference; `count(size, voxels)` is false if the cloud spans too many.
template <class Count>
bool search_size(const Bounds& bounds, int64_t num_points, double tolerance, const Count& count, double& size) {
  double extent = 0;
  for (int axis = 0; axis < 3; ++axis)
    extent = std::max(extent, static_cast<double>(bounds.high[axis]) - static_cast<double>(bounds.low[axis]));
  double too_large = extent > 0 ? 3.0 * extent : 1.0;
  size = too_large;
  if (num_points == 1) return true;
  double enough = extent / std::sqrt(static_cast<double>(num_points));
  int64_t voxels = 0;
  for (;;) {
    if (!count(enough, voxels)) return false;
    if (voxels >= num_points) break;
    too_large = enough;
    enough /= 2;
  }
  while (voxels > num_points && too_large > enough * (1 + tolerance)) {
    const double middle = std::sqrt(enough * too_large);
    int64_t some = 0;
    if (!count(middle, some)) return false;
    if (some >= num_points) {
      enough = middle;
      voxels = some;
    } else {
      too_large = middle;
    }
  }
  size = enough;
  return true;
}

// Counts the voxels of one cloud again and again, on this thread.
template <class Voxel>
class VoxelCount {
 public:
  VoxelCount(ScratchFrame& scratch, int64_t rows) : table_(scratch, rows), voxels_(scratch.take<Voxel>(rows)) {}

  int64_t of(const float* points, int64_t rows, const VoxelGrid& grid) {
    Piece all{0, 0, rows};
    list_piece(points, all, grid, table_, Found<Voxel>{voxels_, nullptr, nullptr});
    return all.num_voxels;
  }

 private:
  VoxelTable<Voxel> table_;
  Voxel* voxels_;
};

// The size of a cloud, found on this thread; false if it has too few distinct points or spans too many voxels.
bool find_size_alone(const float* points, int64_t rows, int64_t num_points, double tolerance, double& size) {
  if (rows < num_points || count_distinct({1, nullptr}, points, rows) < num_points) return false;
  ScratchFrame scratch;
  VoxelCount<PackedVoxel> packed(scratch, rows);
  std::optional<VoxelCount<WideVoxel>> wide;
  const Bounds bounds = bounds_of(points, 0, rows);
  return search_size(
      bounds, num_points, tolerance,
      [&](double at, int64_t& voxels) {
        VoxelGrid grid{};
        if (!measure(bounds, at, grid)) return false;
        if (!grid.packs() && !wide) wide.emplace(scratch, rows);
        voxels = grid.packs() ? packed.of(points, rows, grid) : wide->of(points, rows, grid);
        return true;
      },
      size);
}

// The same with all threads.
bool find_size_together(const pc_context& context, const float* points, int64_t rows, int64_t num_points,
                        double tolerance, double& size) {
  if (rows < num_points || count_distinct(context, points, rows) < num_points) return false;
  const int64_t ptr[2] = {0, rows};
  Pieces pieces(ptr, 1);
  return search_size(
      bounds_of(points, 0, rows), num_points, tolerance,
      [&](double at, int64_t& voxels) {
        ScratchFrame scratch;
        const Clouds cloud{points, ptr, 1, &at};
        return with_grids(context, scratch, cloud, pieces, [&](auto voxel, const VoxelGrid* grids) {
          count<decltype(voxel)>(context, scratch, cloud, pieces, grids, &voxels);
        });
      },
      size);
}

}  // namespace
}  // namespace pc

// points (N, 3); ptr (num_clouds+1,); sizes (num_clouds,) -> means (M, 3) in the first rows of (N, 3); inverse (N,);
// counts (num_clouds,): the voxels of each cloud. Clouds hold less than 2^31 points. *spans_too_many becomes 1, and
// nothing else is written, if a cloud spans 2^53 voxels or more.
PC_EXPORT int32_t pc_voxel_downsample(const pc_context* context, const float* points, const int64_t* ptr,
                                      int64_t num_clouds, const double* sizes, float* means, int64_t* inverse,
                                      int64_t* counts, int64_t* spans_too_many) {
  return pc::guarded([&] {
    pc::ScratchFrame scratch;
    pc::Pieces pieces(ptr, num_clouds);
    const pc::Clouds clouds{points, ptr, num_clouds, sizes};
    *spans_too_many = !pc::with_grids(*context, scratch, clouds, pieces, [&](auto voxel, const pc::VoxelGrid* grids) {
      pc::downsample<decltype(voxel)>(*context, scratch, clouds, pieces, grids, means, inverse, counts);
    });
  });
}

// sizes (num_clouds,): the voxel size that leaves num_points of each cloud, or as few more as possible, found to the
// relative tolerance. *possible becomes 0, and nothing is certain, if a cloud has fewer distinct points or spans 2^53
// voxels of the size that would be needed.
PC_EXPORT int32_t pc_find_voxel_sizes(const pc_context* context, const float* points, const int64_t* ptr,
                                      int64_t num_clouds, int64_t num_points, double tolerance, double* sizes,
                                      int64_t* possible) {
  return pc::guarded([&] {
    std::atomic<bool> all_possible{true};
    std::vector<int64_t> small;
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud) {
      const int64_t rows = ptr[cloud + 1] - ptr[cloud];
      if (rows <= pc::kPiece)
        small.push_back(cloud);
      else if (!pc::find_size_together(*context, points + 3 * ptr[cloud], rows, num_points, tolerance, sizes[cloud]))
        all_possible = false;
    }
    pc::parallel_for(*context, static_cast<int64_t>(small.size()), 1, [&](int64_t i, int64_t, int64_t) {
      const int64_t cloud = small[static_cast<size_t>(i)], rows = ptr[cloud + 1] - ptr[cloud];
      if (all_possible.load(std::memory_order_relaxed) &&
          !pc::find_size_alone(points + 3 * ptr[cloud], rows, num_points, tolerance, sizes[cloud]))
        all_possible.store(false, std::memory_order_relaxed);
    });
    *possible = all_possible;
  });
}
