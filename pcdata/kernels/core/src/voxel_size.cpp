// The voxel size that leaves a number of voxels.
#include <optional>

#include "pc/voxels/numbering.hpp"

namespace pc::voxels {
namespace {

template <class Voxel>
void count(const pc_context& context, ScratchFrame& scratch, const SizedClouds& clouds, Pieces& pieces,
           const VoxelGrid* grids, int64_t* counts) {
  const Found<Voxel> found = room_for<Voxel>(scratch, clouds.ptr[clouds.num_clouds], false);
  auto tables = tables_for<Voxel>(context, scratch, pieces);
  parallel_for(context, pieces.size(), 1, [&](int64_t p, int64_t, int64_t thread) {
    list_piece(clouds.points, pieces[p], grids[pieces[p].cloud], tables[static_cast<size_t>(thread)], found);
  });
  merge_all(scratch, pieces, clouds.num_clouds, found, counts);
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

// Bisect, with the float64 operations of the reference; `count(size, voxels)` is false if the cloud spans too many.
template <class Count>
bool search_size(const math::Bounds& bounds, int64_t num_points, double tolerance, const Count& count, double& size) {
  const double extent = bounds.extent();
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
  const math::Bounds bounds = bounds_of(points, 0, rows);
  return search_size(
      bounds, num_points, tolerance,
      [&](double at, int64_t& voxels) {
        VoxelGrid grid{};
        const double size[3] = {at, at, at};
        if (!measure(bounds, size, nullptr, grid)) return false;
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
        const double size[3] = {at, at, at};
        const SizedClouds cloud{points, ptr, 1, size, nullptr};
        return with_grids(context, scratch, cloud, pieces, [&](auto voxel, const VoxelGrid* grids) {
          count<decltype(voxel)>(context, scratch, cloud, pieces, grids, &voxels);
        });
      },
      size);
}

}  // namespace
}  // namespace pc::voxels

PC_EXPORT int32_t pc_find_voxel_sizes(const pc_context* context, const float* points, const int64_t* ptr,
                                      int64_t num_clouds, int64_t num_points, double tolerance, double* sizes,
                                      int64_t* possible) {
  using namespace pc;
  using namespace pc::voxels;
  return guarded([&] {
    std::atomic<bool> all_possible{true};
    std::vector<int64_t> small;
    for (int64_t cloud = 0; cloud < num_clouds; ++cloud) {
      const int64_t rows = ptr[cloud + 1] - ptr[cloud];
      if (rows <= kPiece)
        small.push_back(cloud);
      else if (!find_size_together(*context, points + 3 * ptr[cloud], rows, num_points, tolerance, sizes[cloud]))
        all_possible = false;
    }
    parallel_for(*context, static_cast<int64_t>(small.size()), 1, [&](int64_t i, int64_t, int64_t) {
      const int64_t cloud = small[static_cast<size_t>(i)], rows = ptr[cloud + 1] - ptr[cloud];
      if (all_possible.load(std::memory_order_relaxed) &&
          !find_size_alone(points + 3 * ptr[cloud], rows, num_points, tolerance, sizes[cloud]))
        all_possible.store(false, std::memory_order_relaxed);
    });
    *possible = all_possible;
  });
}
