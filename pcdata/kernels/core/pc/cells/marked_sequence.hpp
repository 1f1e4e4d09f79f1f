// Radius outliers of points in the order of an image: most find their neighbors beside them in memory.
#pragma once

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <vector>

#include "pc/math/distance.hpp"
#include "pc/simd.hpp"

namespace pc::cells {

struct RadiusSearch {
  const float* points;  // (count, 3) one cloud
  int64_t count;
  float radius, limit;    // a neighbor has d2 < limit
  int64_t enough;         // neighbors that make an inlier, itself included
  uint8_t* outlier;       // (count,) 1 = not yet shown to be an inlier
  const int64_t* pixel;   // (count,) where each point lies in an image, rising; null = unknown
  int64_t width;          // of the image
  const uint8_t* within;  // (count,) the points that there are; null = all

  bool has(int64_t i) const { return within == nullptr || within[i] != 0; }
};

// Call `body` with every row of [begin, end) that is marked when its turn comes; eight unmarked ones are one look.
template <class Body>
void for_each_marked(const uint8_t* marks, int64_t begin, int64_t end, const Body& body) {
  int64_t i = begin;
  const auto look = [&](int64_t until) {
    for (; i < until; ++i)
      if (marks[i]) body(i);
  };
  while (i + 8 <= end) {
    uint64_t eight;
    std::memcpy(&eight, marks + i, sizeof eight);
    if (eight == 0)
      i += 8;
    else
      look(i + 8);
  }
  look(end);
}

// Coordinates of the points around a piece of a cloud, infinitely far away (so never near) outside the cloud.
constexpr int kPiece = 1024;
constexpr int kMostAround = 128;
struct Window {
  static constexpr int kSize = kPiece + 2 * kMostAround;
  alignas(64) float x[kSize + kLanes], y[kSize + kLanes], z[kSize + kLanes];  // a look may end behind it

  void load(const RadiusSearch& search, int64_t first) {  // slot 0 is point `first`, which may be negative
    const int64_t count = search.count;
    const int begin = static_cast<int>(std::clamp<int64_t>(-first, 0, kSize));
    const int end = static_cast<int>(std::clamp<int64_t>(count - first, 0, kSize));
    const auto clear = [&](int from, int to) {
      for (float* axis : {x, y, z}) std::fill(axis + from, axis + to, std::numeric_limits<float>::infinity());
    };
    clear(0, begin);
    clear(end, kSize + kLanes);
    int i = begin;
    for (; i + kLanes <= end; i += kLanes) {
      FloatRegister some[3];
      load_points(search.points + 3 * (first + i), some[0], some[1], some[2]);
      store(x + i, some[0]);
      store(y + i, some[1]);
      store(z + i, some[2]);
    }
    for (; i < end; ++i) {
      const float* point = search.points + 3 * (first + i);
      x[i] = point[0];
      y[i] = point[1];
      z[i] = point[2];
    }
    if (search.within == nullptr) return;
    for (i = begin; i < end; ++i) x[i] = search.within[first + i] ? x[i] : std::numeric_limits<float>::infinity();
  }

  // For each lane whether the point of a slot and on is near one of the points from (qx, qy, qz).
  RegisterMask near(const FloatRegister& qx, const FloatRegister& qy, const FloatRegister& qz, int slot,
                    const FloatRegister& limit) const {
    return less(squared_length(pc::load<FloatRegister>(x + slot) - qx, pc::load<FloatRegister>(y + slot) - qy,
                               pc::load<FloatRegister>(z + slot) - qz),
                limit);
  }
  // How many points up to `close` before and after each of those from a slot on are near it, itself included; counts no
  // further once all have enough.
  Int32Register count_close(int slot, int close, int32_t enough, const FloatRegister& limit) const {
    const auto qx = pc::load<FloatRegister>(x + slot), qy = pc::load<FloatRegister>(y + slot),
               qz = pc::load<FloatRegister>(z + slot);
    const Int32Register wanted = Int32Register{} + enough;
    Int32Register found = Int32Register{} + 1;
    for (int step = 1; step <= close; ++step) {
      found = select(near(qx, qy, qz, slot - step, limit), found + 1, found);
      found = select(near(qx, qy, qz, slot + step, limit), found + 1, found);
      if (2 * step + 1 >= enough && !any(less(found, wanted))) break;
    }
    return found;
  }
  // How many points from `wide` before one to `wide` behind it, or a few more, are near it, itself included.
  int count_wide(int slot, int wide, const FloatRegister& limit) const {
    const FloatRegister qx = FloatRegister{} + x[slot], qy = FloatRegister{} + y[slot], qz = FloatRegister{} + z[slot];
    int found = 0;
    for (int other = slot - wide; other <= slot + wide; other += kLanes)
      found += __builtin_popcount(near(qx, qy, qz, other, limit).bits());
    return found;
  }
};

// Finds the point at about the pixel so many rows away from one point after another. It looks first as many points away
// as it was for the last one: rows of an image lose about equally many pixels.
class PixelSearch {
 public:
  PixelSearch(const RadiusSearch& search, int64_t rows_away) : search_(search), pixels_away_(rows_away * search.width) {
    const int64_t pixels = std::max<int64_t>(search.count, search.pixel[search.count - 1] - search.pixel[0] + 1);
    const double density = static_cast<double>(search.count) / static_cast<double>(pixels);
    points_away_ = static_cast<int64_t>(static_cast<double>(pixels_away_) * density);
  }

  int64_t seek(int64_t i) {
    constexpr int kTries = 4;
    constexpr int64_t kClose = 2;
    const int64_t wanted = search_.pixel[i] + pixels_away_, last = search_.count - 1;
    int64_t at = std::clamp<int64_t>(i + points_away_, 0, last);
    for (int tries = 0;; ++tries) {
      const int64_t short_of = wanted - search_.pixel[at];
      if (std::abs(short_of) <= kClose || at == (short_of < 0 ? 0 : last)) break;
      if (tries == kTries) {
        at = std::lower_bound(search_.pixel, search_.pixel + last, wanted) - search_.pixel;
        break;
      }
      at = std::clamp<int64_t>(at + short_of, 0, last);  // between holes pixels follow one another
    }
    points_away_ = at - i;
    return at;
  }

 private:
  const RadiusSearch& search_;
  int64_t pixels_away_, points_away_;
};

// Whether point i has enough neighbors in the image rows around its own, near rows first. `seekers` has one search for
// each row. Looks at the same number of points in each, and at none twice.
constexpr int kRowsAround = 8, kInRow = 16;
constexpr int64_t rows_away(int seeker) { return (seeker % 2 ? 1 : -1) * (seeker / 2 + 1); }
inline bool enough_in_rows(const RadiusSearch& search, PixelSearch* seekers, int64_t i) {
  const float* q = search.points + 3 * i;
  const FloatRegister qx = FloatRegister{} + q[0], qy = FloatRegister{} + q[1], qz = FloatRegister{} + q[2];
  const FloatRegister limit = FloatRegister{} + search.limit;
  int64_t found = 1, seen_from = i, seen_until = i + 1;
  for (int r = 0; r < 2 * kRowsAround; ++r) {
    const int64_t begin = std::clamp<int64_t>(seekers[r].seek(i) - kInRow / 2, 0, search.count - kInRow);
    const bool above = rows_away(r) < 0;
    if (above ? begin + kInRow > seen_from : begin < seen_until) continue;
    (above ? seen_from : seen_until) = above ? begin : begin + kInRow;
    for (int64_t other = begin; other < begin + kInRow; other += kLanes) {
      FloatRegister x, y, z;
      load_points(search.points + 3 * other, x, y, z);
      uint32_t near = less(squared_length(x - qx, y - qy, z - qz), limit).bits();
      if (search.within == nullptr)
        found += __builtin_popcount(near);
      else
        for (; near != 0; near &= near - 1) found += search.has(other + __builtin_ctz(near));
    }
    if (found >= search.enough) return true;
  }
  return false;
}

// Mark which of some points have fewer neighbors than enough, of those within; returns how many.
inline int64_t mark_fewer(const int32_t* near, int count, int32_t enough, const uint8_t* within, uint8_t* outlier) {
  for (int i = 0; i < count; ++i) outlier[i] = near[i] < enough;
  for (int i = 0; within != nullptr && i < count; ++i) outlier[i] &= within[i] != 0;
  int64_t marked = 0;
  for (int i = 0; i < count; ++i) marked += outlier[i];
  return marked;
}

// Clear the mark of points with enough neighbors among the `close` points before and after them, then among `wide`,
// then in the image rows around them. Returns how many points of [begin, end) stay marked.
inline int64_t search_sequence(const RadiusSearch& search, int64_t begin, int64_t end, int close, int wide) {
  Window window;
  window.load(search, begin - kMostAround);
  const int count = static_cast<int>(end - begin);
  const FloatRegister limit = FloatRegister{} + search.limit;
  const auto enough = static_cast<int32_t>(std::min<int64_t>(search.enough, std::numeric_limits<int32_t>::max()));
  uint8_t* const outlier = search.outlier + begin;
  int32_t near[kPiece];
  for (int i = 0; i < count; i += kLanes) store(near + i, window.count_close(i + kMostAround, close, enough, limit));
  int64_t left = mark_fewer(near, count, enough, search.within ? search.within + begin : nullptr, outlier);
  // A piece whose points have few neighbors so close by in memory is in no order, and a wider look would be wasted.
  if (2 * left > count) return left;
  const bool has_rows = search.pixel != nullptr && search.count >= kInRow;
  std::vector<PixelSearch> seekers;
  for (int r = 0; has_rows && r < 2 * kRowsAround; ++r) seekers.emplace_back(search, rows_away(r));
  for_each_marked(outlier, 0, count, [&](int64_t at) {
    const auto i = static_cast<int>(at);
    const int found = window.count_wide(i + kMostAround, wide, limit);
    outlier[i] = found < enough && !(has_rows && enough_in_rows(search, seekers.data(), begin + i));
    left -= !outlier[i];
  });
  return left;
}

}  // namespace pc::cells
