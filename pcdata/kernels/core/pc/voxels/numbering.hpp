// Numbering the voxels of ragged clouds by first appearance, piece by piece and then together.
#pragma once

#include <cmath>
#include <numeric>
#include <vector>

#include "pc/bounds.hpp"
#include "pc/voxels/block.hpp"
#include "pc/voxels/table.hpp"

namespace pc::voxels {

// Rows that one thread numbers by itself before the numbers are brought together: few enough that the table of a
// coherent piece fits the L2 cache, and that Ctrl-C is answered after some milliseconds.
constexpr int64_t kPiece = 1 << 17;
// Beyond this, float64 no longer tells neighboring voxels apart.
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
      require_numbered(ptr[cloud + 1] - ptr[cloud]);
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

// The grid of a cloud: with voxels of `size` (3,) from `origin` (3,) on, which may be null: Open3D's, half a voxel
// below the lowest corner. False if the cloud spans 2^53 voxels or more, or lies as far from the origin.
inline bool measure(const math::Bounds& bounds, const double* size, const double* origin, VoxelGrid& grid) {
  for (int axis = 0; axis < 3; ++axis) {
    grid.size[axis] = size[axis];
    grid.origin[axis] = origin != nullptr ? origin[axis] : static_cast<double>(bounds.low[axis]) - size[axis] / 2;
    grid.first[axis] = std::floor((static_cast<double>(bounds.low[axis]) - grid.origin[axis]) / size[axis]);
    const double last = std::floor((static_cast<double>(bounds.high[axis]) - grid.origin[axis]) / size[axis]);
    if (!(std::fabs(last) < kMaxVoxelsPerAxis && std::fabs(grid.first[axis]) < kMaxVoxelsPerAxis)) return false;
    const double width = last - grid.first[axis];
    grid.bits[axis] = 0;
    while (std::ldexp(1.0, grid.bits[axis]) <= width) ++grid.bits[axis];
    if (grid.bits[axis] > kMaxPackedBits) grid.bits[axis] = 64;
  }
  return true;
}

// Clouds, the size of each one's voxels, and where its grid starts.
struct SizedClouds {
  const float* points;  // (rows, 3)
  const int64_t* ptr;
  int64_t num_clouds;
  const double* sizes;    // (num_clouds, 3)
  const double* origins;  // (num_clouds, 3) or null
};

// The grid of every cloud; false if one spans too many voxels.
inline bool measure_all(const pc_context& context, ScratchFrame& scratch, const SizedClouds& clouds, Pieces& pieces,
                        VoxelGrid* grids) {
  math::Bounds* bounds = scratch.take<math::Bounds>(pieces.size());
  parallel_for(context, pieces.size(), 1, [&](int64_t p, int64_t, int64_t) {
    bounds[p] = bounds_of(clouds.points, pieces[p].begin, pieces[p].end);
  });
  for (int64_t cloud = 0; cloud < clouds.num_clouds; ++cloud) {
    const int64_t first = pieces.first(cloud), last = pieces.first(cloud + 1);
    if (first == last) continue;
    math::Bounds all = bounds[first];
    for (int64_t p = first + 1; p < last; ++p) all.include(bounds[p]);
    const double* origin = clouds.origins == nullptr ? nullptr : clouds.origins + 3 * cloud;
    if (!measure(all, clouds.sizes + 3 * cloud, origin, grids[cloud])) return false;
  }
  return true;
}

// Where the pieces leave their results: piece p owns [begin, end) of each, like its rows, and uses what it needs.
template <class Voxel>
struct Found {
  Voxel* voxels;    // by number
  VoxelSum* sums;   // by number; null if nobody asks
  int32_t* common;  // the number of a piece's voxel in its cloud, by its number in the piece
};

// Number the voxels of one piece by first appearance and sum the offsets of their points.
template <class Voxel>
void number_piece(const float* points, Piece& piece, const VoxelGrid& grid, VoxelTable<Voxel>& table,
                  const Found<Voxel>& found, int64_t* numbers) {
  VoxelBlock block;
  Voxel voxels[VoxelBlock::kSize];
  VoxelSum* sums = found.sums + piece.begin;
  table.start(found.voxels + piece.begin);
  // Neighboring rows often share a voxel: a run of them is summed in registers.
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

// Call body(a voxel of the type that the clouds need); false if one spans too many voxels.
template <class Body>
bool with_grids(const pc_context& context, ScratchFrame& scratch, const SizedClouds& clouds, Pieces& pieces,
                Body&& body) {
  std::vector<VoxelGrid> grids(static_cast<size_t>(clouds.num_clouds));
  for (VoxelGrid& grid : grids) grid = {};
  if (!measure_all(context, scratch, clouds, pieces, grids.data())) return false;
  if (std::all_of(grids.begin(), grids.end(), [](const VoxelGrid& grid) { return grid.packs(); }))
    body(PackedVoxel{}, grids.data());
  else
    body(WideVoxel{}, grids.data());
  return true;
}

}  // namespace pc::voxels
