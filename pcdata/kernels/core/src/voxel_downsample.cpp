// Voxel down-sampling.
#include "pc/voxels/numbering.hpp"

namespace pc::voxels {
namespace {

template <class Voxel>
void downsample(const pc_context& context, ScratchFrame& scratch, const SizedClouds& clouds, Pieces& pieces,
                const VoxelGrid* grids, float* means, int64_t* inverse, int64_t* members, int64_t* counts) {
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
    const int64_t start = starts[static_cast<size_t>(piece.cloud)];
    for (int64_t i = piece.begin; i < end; ++i) {
      mean_of(found.voxels[i], found.sums[i], grids[piece.cloud], means + 3 * (start + i - base));
      members[start + i - base] = found.sums[i].count;
    }
  });
}

}  // namespace
}  // namespace pc::voxels

PC_EXPORT int32_t pc_voxel_downsample(const pc_context* context, const float* points, const int64_t* ptr,
                                      int64_t num_clouds, const double* sizes, const double* origins, float* means,
                                      int64_t* inverse, int64_t* members, int64_t* counts, int64_t* spans_too_many) {
  using namespace pc;
  using namespace pc::voxels;
  return guarded([&] {
    ScratchFrame scratch;
    Pieces pieces(ptr, num_clouds);
    const SizedClouds clouds{points, ptr, num_clouds, sizes, origins};
    *spans_too_many = !with_grids(*context, scratch, clouds, pieces, [&](auto voxel, const VoxelGrid* grids) {
      downsample<decltype(voxel)>(*context, scratch, clouds, pieces, grids, means, inverse, members, counts);
    });
  });
}
