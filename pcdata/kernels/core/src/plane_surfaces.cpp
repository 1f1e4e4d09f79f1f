// The part of each plane that is a surface: which of the points near it, how far those are from it, and their hull.
#include <cmath>
#include <tuple>

#include "pc/planes/clouds.hpp"
#include "pc/planes/hull.hpp"
#include "pc/planes/outline.hpp"
#include "pc/planes/patch_cells.hpp"

namespace pc::planes {
namespace {

constexpr int64_t kPieceRuns = 128;  // runs that are looked at on their own; what they give is put together in order
static_assert(kPieceRuns * kRun == kSmallCloud);

// One bit for each of up to 64 bytes of 0 and 1.
uint64_t bits_of(const uint8_t* bytes, int64_t count) {
  uint64_t bits = 0;
  for (int64_t i = 0; i < count; i += 8) {
    uint64_t eight = 0;
    std::memcpy(&eight, bytes + i, static_cast<size_t>(std::min<int64_t>(8, count - i)));
    bits |= (eight * 0x0102040810204080U >> 56) << i;
  }
  return bits;
}

// Add the squared distances of chosen points of a run from a plane, in eight lanes whatever the instruction set.
void add_squares(const RunPoints& points, uint64_t chosen, const double* plane, Double8& sum) {
  alignas(64) float axes[3][kRun];
  points.each([&](const FloatRegister& x, const FloatRegister& y, const FloatRegister& z, int i) {
    store(axes[0] + i, x);
    store(axes[1] + i, y);
    store(axes[2] + i, z);
  });
  for (int i = 0; i < kRun; i += 8) {
    const auto mine = static_cast<int64_t>(chosen >> i & 0xFF);
    if (mine == 0) continue;
    constexpr Long8 places = {1, 2, 4, 8, 16, 32, 64, 128};
    const auto wide = [&](int axis) { return __builtin_convertvector(load<Float8>(axes[axis] + i), Double8); };
    const Double8 off = ((wide(0) * plane[0] + wide(1) * plane[1]) + wide(2) * plane[2]) + plane[3];
    sum += reinterpret_cast<Double8>(reinterpret_cast<Long8>(off * off) & ((places & mine) != 0));
  }
}

// Corners of a polygon, of which the one whose triangle with its neighbors is smallest goes, again and again.
class Corners {
 public:
  Corners(const double* places, std::vector<int64_t> rows) : places_(places), rows_(std::move(rows)) {}

  const std::vector<int64_t>& at_most(int64_t most) {
    std::vector<double> sizes;
    if (count() > most)
      for (int64_t at = 0; at < count(); ++at) sizes.push_back(size_of(at));
    while (count() > most) {
      const auto gone = std::min_element(sizes.begin(), sizes.end()) - sizes.begin();
      sizes.erase(sizes.begin() + gone);
      rows_.erase(rows_.begin() + gone);
      for (const int64_t at : {(gone + count() - 1) % count(), gone % count()})
        sizes[static_cast<size_t>(at)] = size_of(at);
    }
    return rows_;
  }

 private:
  int64_t count() const { return static_cast<int64_t>(rows_.size()); }
  const double* place(int64_t at) const { return places_ + 2 * rows_[static_cast<size_t>((at + count()) % count())]; }
  // Twice the area of the triangle of a corner and its neighbors.
  double size_of(int64_t at) const {
    const double *left = place(at - 1), *own = place(at), *right = place(at + 1);
    return std::fabs((left[0] - own[0]) * (right[1] - own[1]) - (left[1] - own[1]) * (right[0] - own[0]));
  }

  const double* places_;
  std::vector<int64_t> rows_;
};

// The surface of one plane, in one cloud.
class Surface {
 public:
  Surface(const pc_context& context, const float* points, int64_t count, const double* plane)
      : context_(context), points_(points), count_(count), plane_(plane), axes_(plane) {}

  // False where places are too far away to be numbered.
  bool find(const uint8_t* near, double distance, int64_t most_corners, uint8_t* patch, int64_t* corners,
            double* rms) const {
    ScratchFrame scratch;
    const Plane rounded{static_cast<float>(plane_[0]), static_cast<float>(plane_[1]), static_cast<float>(plane_[2]),
                        static_cast<float>(plane_[3])};
    const PatchCells cells(context_, points_, near, count_, rounded, axes_, distance, scratch);
    if (cells.is_too_far()) return false;
    if (cells.are_any())
      mark(cells, near, patch);
    else
      std::copy_n(near, count_, patch);
    const std::vector<int64_t> rows = outline(patch, rms, scratch);
    auto* places = scratch.take<double>(2 * static_cast<int64_t>(rows.size()));
    for (size_t i = 0; i < rows.size(); ++i) {
      places[2 * i] = axes_.along_down(points_ + 3 * rows[i]);
      places[2 * i + 1] = axes_.along_right(points_ + 3 * rows[i]);
    }
    std::vector<int64_t> hull(rows.size());
    hull.resize(static_cast<size_t>(
        pc::outline::convex_hull(context_, places, static_cast<int64_t>(rows.size()), hull.data())));
    Corners all(places, std::move(hull));
    std::fill_n(corners, most_corners, int64_t{-1});
    for (const int64_t at : all.at_most(most_corners)) *corners++ = rows[static_cast<size_t>(at)];
    return true;
  }

 private:
  int64_t num_runs() const { return (count_ + kRun - 1) / kRun; }

  // Mark the points near the plane that lie in marked cells.
  void mark(const PatchCells& patch, const uint8_t* near, uint8_t* inside) const {
    const Axis down(axes_.down), right(axes_.right);
    const FlatCells& cells = patch.cells();
    const uint8_t* marked = patch.marked();
    parallel_for(context_, num_runs(), kPieceRuns, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t run = begin; run < end; ++run) {
        const RunPoints own(points_, count_, run);
        const uint8_t* mine = near + kRun * run;
        uint8_t* to = inside + kRun * run;
        if (std::memchr(mine, 1, static_cast<size_t>(own.size())) == nullptr) {
          std::fill_n(to, own.size(), uint8_t{0});
          continue;
        }
        int32_t place[kRun];
        own.each([&](const FloatRegister& x, const FloatRegister& y, const FloatRegister& z, int i) {
          store(place + i, cells.of(down.along(x, y, z), right.along(x, y, z)));
        });
        for (int i = 0; i < own.size(); ++i) to[i] = mine[i] & marked[place[i]];
      }
    });
  }

  // Points among which are all corners of the hull of those chosen; and the RMS distance of these from the plane.
  std::vector<int64_t> outline(const uint8_t* chosen, double* rms, ScratchFrame& scratch) const {
    const Outline outline(context_, points_, chosen, count_, axes_, scratch);
    struct Piece {
      std::vector<int64_t> rows;
      double squares = 0;
      int64_t chosen = 0;
    };
    const int64_t num_pieces = (num_runs() + kPieceRuns - 1) / kPieceRuns;
    std::vector<Piece> pieces(static_cast<size_t>(num_pieces));
    parallel_for(context_, num_pieces, 1, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t piece = first; piece < last; ++piece) {
        Piece& found = pieces[static_cast<size_t>(piece)];
        Double8 sum{};
        for (int64_t run = piece * kPieceRuns; run < std::min(num_runs(), (piece + 1) * kPieceRuns); ++run) {
          const uint64_t mine = bits_of(chosen + kRun * run, std::min<int64_t>(kRun, count_ - kRun * run));
          if (mine == 0) continue;
          const RunPoints own(points_, count_, run);
          uint64_t inside = 0;
          own.each([&](const FloatRegister& x, const FloatRegister& y, const FloatRegister& z, int i) {
            const auto asked = static_cast<uint32_t>(mine >> i) & all_lanes().bits();
            inside |= static_cast<uint64_t>(outline.inside(x, y, z, asked)) << i;
          });
          for (uint64_t bits = mine & ~inside; bits != 0; bits &= bits - 1)
            found.rows.push_back(kRun * run + __builtin_ctzll(bits));
          add_squares(own, mine, plane_, sum);
          found.chosen += __builtin_popcountll(mine);
        }
        found.squares = reduce<double>(sum, [](const auto& a, const auto& b) { return a + b; });
      }
    });
    std::vector<int64_t> rows;
    double squares = 0;
    int64_t num_chosen = 0;
    for (const Piece& piece : pieces) {
      squares += piece.squares;
      num_chosen += piece.chosen;
      rows.insert(rows.end(), piece.rows.begin(), piece.rows.end());
    }
    *rms = std::sqrt(squares / static_cast<double>(std::max<int64_t>(1, num_chosen)));
    return rows;
  }

  const pc_context& context_;
  const float* points_;
  int64_t count_;
  const double* plane_;
  PlaneAxes axes_;
};

}  // namespace
}  // namespace pc::planes

PC_EXPORT int32_t pc_plane_surfaces(const pc_context* context, const float* points, const int64_t* ptr,
                                    int64_t num_clouds, const uint8_t* near, const double* planes, double distance,
                                    int64_t most_corners, uint8_t* patch, int64_t* corners, double* rms) {
  using namespace pc;
  using namespace pc::planes;
  return guarded([&] {
    const auto find = [&](const pc_context& own_context, int64_t cloud) {
      const int64_t begin = ptr[cloud];
      int64_t* own = corners + most_corners * cloud;
      const bool is_found = Surface(own_context, points + 3 * begin, ptr[cloud + 1] - begin, planes + 4 * cloud)
                                .find(near + begin, distance, most_corners, patch + begin, own, rms + cloud);
      if (!is_found) rms[cloud] = -1;
      for (int64_t k = 0; is_found && k < most_corners && own[k] >= 0; ++k) own[k] += begin;
    };
    for_each_cloud(*context, ptr, num_clouds, 4, find);
  });
}
