// Sums over chosen points, for the least-squares plane through them.
#include "pc/planes/plane_sums.hpp"
#include "pc/threads.hpp"

namespace pc::planes {
namespace {

constexpr int64_t kSummedPiece = 8192;  // points summed on their own; pieces are added in order
constexpr int kBlock = 64;              // points with one array per coordinate at a time

struct Sums {
  PlaneMoments moments;
  int32_t largest = 0;  // absolute coordinate; as bits, which order like the numbers while none is negative
  int64_t count = 0;
};

// Add the chosen points of [begin, end), at most kBlock.
void add_block(const float* points, const uint8_t* mask, int64_t begin, int64_t end, const double* center, Sums& sums) {
  alignas(64) float axes[3][kBlock];
  alignas(64) int64_t taken[kBlock];  // all ones where chosen
  const int count = static_cast<int>(end - begin);
  // A sum does not change by the zeros of points that are not chosen.
  if (std::memchr(mask + begin, 1, static_cast<size_t>(count)) == nullptr) return;
  for (int i = 0; i < count; ++i)
    for (int axis = 0; axis < 3; ++axis) axes[axis][i] = points[3 * (begin + i) + axis];
  for (int i = 0; i < count; ++i) taken[i] = -static_cast<int64_t>(mask[begin + i]);
  for (int i = 0; i < count; ++i) sums.count += mask[begin + i];
  for (const auto& values : axes) {
    int32_t largest = 0;
    for (int i = 0; i < count; ++i) {
      int32_t bits;
      std::memcpy(&bits, values + i, 4);
      largest = std::max(largest, bits & 0x7FFFFFFF & static_cast<int32_t>(taken[i]));
    }
    sums.largest = std::max(sums.largest, largest);
  }
  const int whole = (count + 7) / 8 * 8;
  for (int i = count; i < whole; ++i) axes[0][i] = axes[1][i] = axes[2][i] = 0, taken[i] = 0;
  for (int i = 0; i < whole; i += 8) {
    const auto mine = load<Long8>(taken + i);
    Double8 offset[3];
    for (int axis = 0; axis < 3; ++axis) {
      const Double8 value = __builtin_convertvector(load<Float8>(axes[axis] + i), Double8) - center[axis];
      offset[axis] = reinterpret_cast<Double8>(reinterpret_cast<Long8>(value) & mine);
    }
    sums.moments.add(offset[0], offset[1], offset[2]);
  }
}

}  // namespace
}  // namespace pc::planes

PC_EXPORT int32_t pc_moments(const pc_context* context, const float* points, const int64_t* ptr, int64_t num_clouds,
                             const uint8_t* mask, const double* centers, double* sums) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const auto pieces = cut_clouds(ptr, num_clouds, kSummedPiece);
    std::vector<Sums> found(pieces.size());
    constexpr int64_t kRowsAtOnce = 8 * kSummedPiece;  // 50 us of a thread
    for_each_piece(*context, pieces, kRowsAtOnce, [&](const CloudPiece& piece, int64_t number) {
      Sums own;
      for (int64_t first = piece.begin; first < piece.end; first += kBlock)
        add_block(points, mask, first, std::min<int64_t>(piece.end, first + kBlock), centers + 3 * piece.cloud, own);
      found[static_cast<size_t>(number)] = own;
    });
    std::fill_n(sums, 11 * num_clouds, 0.0);
    for (size_t p = 0; p < pieces.size(); ++p) {
      const PlaneMoments& m = found[p].moments;
      const Double8 lanes[9] = {m.x, m.y, m.z, m.xx, m.xy, m.xz, m.yy, m.yz, m.zz};
      double* to = sums + 11 * pieces[p].cloud;
      float largest;
      std::memcpy(&largest, &found[p].largest, 4);
      to[0] += static_cast<double>(found[p].count);
      to[1] = std::max(to[1], static_cast<double>(largest));
      for (int k = 0; k < 9; ++k)
        for (int lane = 0; lane < 8; ++lane) to[2 + k] += lanes[k][lane];
    }
  });
}
