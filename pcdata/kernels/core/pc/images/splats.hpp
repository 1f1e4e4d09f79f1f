// Points as squares of pixels.
#pragma once

#include <cmath>
#include <vector>

#include "pc/images/z_buffer.hpp"
#include "pc/math/camera.hpp"

namespace pc::images {

struct Cameras {
  const double* intrinsics;  // (views, 3, 3)
  const double* lenses;      // (views, 14) or null
  int64_t height, width;

  math::PinholeCamera camera(int64_t view) const { return math::PinholeCamera::of(intrinsics + 9 * view); }
  const math::Lens* lens(int64_t view) const {
    return lenses == nullptr ? nullptr : reinterpret_cast<const math::Lens*>(lenses + 14 * view);
  }
};
static_assert(sizeof(math::Lens) == 14 * sizeof(double), "lenses are rows of 14 numbers");

// The squares of some points of one view, computed side by side. What is not seen has an empty one.
class Splats {
 public:
  static constexpr int kSize = 256;

  void place(const float* points, int count, const Cameras& cameras, int64_t view, double point_size) {
    if (const math::Lens* lens = cameras.lens(view))
      project(points, count, cameras.camera(view), lens);
    else
      project(points, count, cameras.camera(view), nullptr);
    const math::PinholeCamera camera = cameras.camera(view);
    span(count, u_, point_size * camera.fx, point_size > 0, cameras.width, left, right);
    span(count, v_, point_size * camera.fy, point_size > 0, cameras.height, top, bottom);
  }

  alignas(64) int32_t left[kSize], right[kSize], top[kSize], bottom[kSize];
  float z(int i) const { return z_[i]; }

 private:
  static constexpr double kLargest = 65.0;  // pixels that a point is wide at most

  [[gnu::always_inline]] void project(const float* points, int count, const math::PinholeCamera& camera,
                                      const math::Lens* lens) {
    for (int i = 0; i < count; ++i) {
      const float* p = points + 3 * i;
      const math::Pixel at = camera.pixel(p[0], p[1], p[2], lens);
      // Beyond every image.
      u_[i] = at.seen ? at.u : -1e9;
      v_[i] = at.seen ? at.v : -1e9;
      z_[i] = p[2];
    }
  }

  // The pixel centers within half a width of a place, among `size`.
  [[gnu::always_inline]] void span(int count, const double* place, double length, bool is_wide, int64_t size,
                                   int32_t* first, int32_t* end) const {
    const auto most = static_cast<double>(size);
    for (int i = 0; i < count; ++i) {
      double half = 0.5;
      if (is_wide) {
        const double width = length / static_cast<double>(z_[i]);
        half = (width < 1.0 ? 1.0 : width < kLargest ? width : kLargest) / 2;
      }
      const double low = std::ceil(place[i] - half), high = std::ceil(place[i] + half);
      first[i] = static_cast<int32_t>(low < 0 ? 0.0 : low < most ? low : most);
      end[i] = static_cast<int32_t>(high < 0 ? 0.0 : high < most ? high : most);
    }
  }

  alignas(64) double u_[kSize], v_[kSize];
  alignas(64) float z_[kSize];
};

// Call body(splats, count, first row) for the rows of a piece, some at a time.
template <class Body>
void for_splats(const float* points, const CloudPiece& piece, const Cameras& cameras, double point_size, Body&& body) {
  Splats splats;
  for (int64_t first = piece.begin; first < piece.end; first += Splats::kSize) {
    const auto count = static_cast<int>(std::min<int64_t>(Splats::kSize, piece.end - first));
    splats.place(points + 3 * first, count, cameras, piece.cloud, point_size);
    body(splats, count, first);
  }
}

// Wide points cover many pixels each, most of them in vain: every thread gets rows of the images for itself, and all
// points that reach them.
class BandDrawing {
 public:
  BandDrawing(const ZBuffer& image, const Cameras& cameras)
      : image_(image), cameras_(cameras), rows_(image.views * cameras.height) {
    constexpr int64_t kPerThread = 8, kFewest = 8;
    const int64_t wanted = kPerThread * image.context.threads;
    rows_per_band_ = std::max(kFewest, (rows_ + wanted - 1) / wanted);
    bands_ = (rows_ + rows_per_band_ - 1) / rows_per_band_;
  }

  void run(const float* points, const int64_t* ptr, double point_size) const {
    constexpr int64_t kRows = 4096, kPieces = 256;
    const auto pieces = cut_clouds(ptr, image_.views, kRows);
    const auto count = static_cast<int64_t>(pieces.size());
    for (int64_t first = 0; first < count; first += kPieces)
      draw(points, pieces.data() + first, std::min(kPieces, count - first), point_size);
  }

 private:
  struct Square {
    int64_t top, bottom;  // rows of all views
    int32_t left, right;
  };

  void draw(const float* points, const CloudPiece* pieces, int64_t count, double point_size) const {
    if (count == 0) return;
    ScratchFrame scratch;
    const int64_t base = pieces[0].begin, rows = pieces[count - 1].end - base;
    Square* square = scratch.take<Square>(rows);
    int64_t* place = scratch.take<int64_t>(count * bands_);  // first how many squares of a piece lie in a band
    std::fill_n(place, count * bands_, int64_t{0});
    parallel_for(image_.context, count, 1, [&](int64_t p, int64_t, int64_t) {
      const int64_t before = pieces[p].cloud * cameras_.height;
      for_splats(points, pieces[p], cameras_, point_size, [&](const Splats& splats, int some, int64_t first) {
        for (int i = 0; i < some; ++i) {
          Square& own = square[first + i - base];
          own = {before + splats.top[i], before + splats.bottom[i], splats.left[i], splats.right[i]};
          for_bands(own, [&](int64_t band) { ++place[p * bands_ + band]; });
        }
      });
    });
    int64_t total = 0;
    int64_t* start = scratch.take<int64_t>(bands_ + 1);
    for (int64_t band = 0; band < bands_; ++band) {
      start[band] = total;
      for (int64_t p = 0; p < count; ++p) {
        const int64_t size = place[p * bands_ + band];
        place[p * bands_ + band] = total;
        total += size;
      }
    }
    start[bands_] = total;
    uint32_t* of_band = scratch.take<uint32_t>(total);
    parallel_for(image_.context, count, 1, [&](int64_t p, int64_t, int64_t) {
      for (int64_t row = pieces[p].begin; row < pieces[p].end; ++row)
        for_bands(square[row - base],
                  [&](int64_t band) { of_band[place[p * bands_ + band]++] = static_cast<uint32_t>(row - base); });
    });
    parallel_for(image_.context, bands_, 1, [&](int64_t band, int64_t, int64_t) {
      const int64_t low = band * rows_per_band_, high = std::min(rows_, low + rows_per_band_);
      for (int64_t at = start[band]; at < start[band + 1]; ++at) {
        const int64_t row = base + of_band[at];
        fill(square[row - base], low, high, front_key(points[3 * row + 2], row));
      }
    });
  }

  template <class Body>
  void for_bands(const Square& square, Body&& body) const {
    if (square.left >= square.right || square.top >= square.bottom) return;
    const int64_t last = (square.bottom - 1) / rows_per_band_;
    for (int64_t band = square.top / rows_per_band_; band <= last; ++band) body(band);
  }

  void fill(const Square& square, int64_t low, int64_t high, uint64_t key) const {
    const int64_t bottom = std::min(square.bottom, high);
    for (int64_t row = std::max(square.top, low); row < bottom; ++row) {
      uint64_t* pixel = image_.keys(0) + row * cameras_.width;
      for (int64_t u = square.left; u < square.right; ++u) pixel[u] = key < pixel[u] ? key : pixel[u];
    }
  }

  const ZBuffer& image_;
  const Cameras& cameras_;
  int64_t rows_, rows_per_band_, bands_;
};

}  // namespace pc::images
