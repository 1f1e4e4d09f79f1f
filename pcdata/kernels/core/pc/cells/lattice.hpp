// Cells so small that all points in one are neighbors, and the points sorted into them.
//
// A cell's side is the radius over sqrt(3), so its diagonal is just under the radius. Only occupied cells exist. A key
// numbers the cells of the cloud's bounding box row-major (x, y, z), so the cells that differ only in z, a "row", lie
// side by side when sorted, and so do their points.
#pragma once

#include <cmath>
#include <limits>
#include <new>

#include "pc/math/bounds.hpp"
#include "pc/sort/radix.hpp"
#include "pc/threads.hpp"

namespace pc::cells {

// The diagonal stays under the radius by far more than float distances (2e-7) and cell borders (2e-5) can err.
constexpr double kCellMargin = 1e-4;
// Up to here a double cell coordinate errs by less than 2^-16 of a cell. The reference has the same limit.
constexpr double kMostCellsPerAxis = 68719476736.0;  // 2^36
// ceil(sqrt(3) * (1 + margin)): neighbors within the radius are at most two cells away on every axis.
constexpr int kReach = 2;

// Cell keys: nearly every scene fits in the first, which doubles hold exactly (a cube of 1.2 km in cells for 1 cm);
// the second holds three coordinates of 37 bits, the most there can be.
using NarrowKey = uint64_t;
__extension__ typedef unsigned __int128 WideKey;
constexpr double kNarrowKeys = 9007199254740992.0;  // 2^53

inline double cell_side(float radius) { return static_cast<double>(radius) / std::sqrt(3.0) * (1 - kCellMargin); }

inline void raise_to(std::atomic<double>& most, double value) {
  double seen = most.load();
  while (value > seen && !most.compare_exchange_weak(seen, value)) {}
}

// Call body(cloud, serial context or not) for every cloud: large ones one after another with all threads, small ones
// side by side with one thread each. `ptr` is (B+1,).
template <class Body>
void for_each_cloud(const pc_context& context, const int64_t* ptr, int64_t clouds, Body&& body) {
  constexpr int64_t kLarge = 1 << 15;  // below this, threads cost more than they give
  std::vector<int64_t> small;
  for (int64_t cloud = 0; cloud < clouds; ++cloud) {
    const int64_t count = ptr[cloud + 1] - ptr[cloud];
    require_numbered(count);
    if (count >= kLarge)
      body(context, ptr[cloud], count);
    else if (count > 0)
      small.push_back(cloud);
  }
  const pc_context alone{1, nullptr};
  parallel_for(context, static_cast<int64_t>(small.size()), 4, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t i = begin; i < end; ++i) body(alone, ptr[small[i]], ptr[small[i] + 1] - ptr[small[i]]);
  });
}

// The largest cell coordinate in the box, computed as the reference computes it.
inline double largest_coordinate(const math::Bounds& box, double side) {
  double largest = 0;
  for (int axis = 0; axis < 3; ++axis) largest = std::max(largest, box.exact_length(axis) / side);
  return largest;
}

// Where the cells of a cloud lie and how they are numbered.
struct Lattice {
  double low[3];
  double per_length;
  double span[3];  // cells along each axis, with room of kReach at both ends: a neighbor's key never wraps

  Lattice(const math::Bounds& box, double side) : per_length(1.0 / side) {
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = static_cast<double>(box.low[axis]);
      span[axis] = std::floor((static_cast<double>(box.high[axis]) - low[axis]) * per_length) + 1 + 2 * kReach;
    }
  }
  bool fits_narrow() const {
    constexpr double kMostPerAxis = 1 << 30;
    return span[0] < kMostPerAxis && span[1] < kMostPerAxis && span[2] < kMostPerAxis &&
           span[0] * span[1] * span[2] < kNarrowKeys;
  }
  template <class Key>
  Key row_step(int dx, int dy) const {  // from a key to the key of the cell (dx, dy, 0) away, modulo the key's range
    const Key dx_rows = static_cast<Key>(span[1]) * static_cast<Key>(dx) + static_cast<Key>(dy);
    return dx_rows * static_cast<Key>(span[2]);
  }
  template <class Key>
  int key_bits() const {
    return sort::bits_below<Key>(static_cast<Key>(span[0]) * static_cast<Key>(span[1]) * static_cast<Key>(span[2]));
  }
};

}  // namespace pc::cells
