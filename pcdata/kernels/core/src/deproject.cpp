// Depth images to points, with what other images say about the same pixels. Two passes: the first decides which pixels
// become points and counts them, the second writes.
#include <cstring>

#include "pc/math/affine.hpp"
#include "pc/memory.hpp"
#include "pc/rows/runs.hpp"
#include "pc/threads.hpp"

namespace pc::images {
namespace {

constexpr int64_t kRowsPerPiece = 16;

// Depth images (views, height, width) and the directions in which their pixels look.
struct Images {
  const float* depth;
  int64_t views, height, width;
  // Pinhole cameras without distortion: x/z of every column (views, width), y/z of every image row (views, height).
  const float* column_rays;
  const float* row_rays;
  // Or any cameras: x/z and y/z of every pixel (views, height, width, 2); null for the pinhole ones.
  const float* rays;

  int64_t rows() const { return views * height; }
  const float* row_depth(int64_t row) const { return depth + row * width; }

  // Call body with a function from column and depth to the point.
  template <class Body>
  void with_points_of_row(int64_t row, const Body& body) const {
    if (rays != nullptr) {
      const float* ray = rays + 2 * row * width;
      body([ray](int64_t u, float z) { return math::Point{ray[2 * u] * z, ray[2 * u + 1] * z, z}; });
    } else {
      const float* x = column_rays + row / height * width;
      const float y = row_rays[row];
      body([x, y](int64_t u, float z) { return math::Point{x[u] * z, y * z, z}; });
    }
  }
  // The same with the points moved by the matrix (4, 4) of their view; matrices may be null.
  template <class Body>
  void with_moved_points_of_row(int64_t row, const double* matrices, const Body& body) const {
    with_points_of_row(row, [&](const auto& point) {
      if (matrices == nullptr) return body(point);
      const math::Affine move(matrices + 16 * (row / height));
      body([&](int64_t u, float z) { return move(point(u, z)); });
    });
  }
};

// What makes a reading a point. Depths below 0 and NaN are no readings but mistakes.
struct Choice {
  float near, far;
  const uint8_t* mask;       // (views, height, width) or null
  const double* matrices;    // (views, 4, 4) or null: what brings points to the box
  const math::CropBox* box;  // or null
};

// Decide about one image row: keep (width,) becomes 1 where a pixel becomes a point. Returns the number of readings
// that the box decided about, or -1 for a depth, a ray or a point that cannot be. Separate plain loops: they vectorize.
int64_t choose_row(const Images& images, int64_t row, const Choice& choice, uint8_t* __restrict keep) {
  const int64_t width = images.width;
  const float* __restrict depth = images.row_depth(row);
  const float near = choice.near, far = choice.far;
  int32_t readings = 0, wrong = 0;
  for (int64_t u = 0; u < width; ++u) wrong |= !(depth[u] >= 0);
  for (int64_t u = 0; u < width; ++u) keep[u] = (depth[u] > 0) & (depth[u] >= near) & (depth[u] <= far);
  if (choice.mask != nullptr) {
    const uint8_t* __restrict mask = choice.mask + row * width;
    for (int64_t u = 0; u < width; ++u) keep[u] &= mask[u] != 0;
  }
  for (int64_t u = 0; u < width; ++u) readings += keep[u];
  if (images.rays != nullptr) {
    const float* __restrict ray = images.rays + 2 * row * width;
    for (int64_t u = 0; u < width; ++u) wrong |= keep[u] & (ray[2 * u] != ray[2 * u]);
  }
  if (choice.box != nullptr) {
    const math::CropBox box = *choice.box;
    images.with_moved_points_of_row(row, choice.matrices, [&](const auto& point) {
      int32_t infinite = 0;
      for (int64_t u = 0; u < width; ++u) {
        const math::Point p = point(u, depth[u]);
        infinite |= keep[u] & !math::is_finite(p);
        keep[u] &= box.contains(p);
      }
      wrong |= infinite;
    });
  }
  return wrong != 0 ? -1 : readings;
}

// What goes along with the points: RGB images become float colors, other images are copied pixel by pixel. All images
// are (views, height, width, ...).
struct Companions {
  const uint8_t* rgb;  // or null
  float* colors;       // (M, 3), in [0, 1]
  int64_t num_copied;
  const int64_t* sources;  // addresses of the images
  const int64_t* pixel_bytes;
  const int64_t* copies;  // addresses of their rows, (M, ...)

  void write(int64_t pixel, int64_t row, int64_t count) const {
    if (rgb != nullptr) {
      const uint8_t* from = rgb + 3 * pixel;
      float* to = colors + 3 * row;
      for (int64_t i = 0; i < 3 * count; ++i) to[i] = static_cast<float>(from[i]) / 255.0F;
    }
    for (int64_t image = 0; image < num_copied; ++image) {
      const int64_t bytes = pixel_bytes[image];
      std::memcpy(reinterpret_cast<char*>(copies[image]) + row * bytes,
                  reinterpret_cast<const char*>(sources[image]) + pixel * bytes, static_cast<size_t>(count * bytes));
    }
  }
};

// Where the points go.
struct Output {
  const int64_t* starts;  // (views * height + 1,): the first point of every image row
  float* points;          // (M, 3)
  int64_t* pixel_index;   // (M,)
  bool over_all_views;    // pixels are numbered over all views, not within their own image
  Companions companions;
};

// Write the points of one image row, run by run: within a run there is nothing to decide. `runs` has room for a row's.
void write_row(const Images& images, int64_t row, const uint8_t* keep, const double* matrices, const Output& out,
               rows::Run* runs) {
  const float* depth = images.row_depth(row);
  const int64_t first_pixel = row * images.width;
  const int64_t first_index = (out.over_all_views ? row : row % images.height) * images.width;
  const int64_t num_runs = rows::find_runs(keep, 0, images.width, runs);
  images.with_moved_points_of_row(row, matrices, [&](const auto& point) {
    int64_t next = out.starts[row];
    for (int64_t r = 0; r < num_runs; ++r) {
      const int64_t start = runs[r].start, length = runs[r].length;
      for (int64_t i = 0; i < length; ++i) {
        const math::Point p = point(start + i, depth[start + i]);
        out.points[3 * (next + i)] = p.x;
        out.points[3 * (next + i) + 1] = p.y;
        out.points[3 * (next + i) + 2] = p.z;
      }
      for (int64_t i = 0; i < length; ++i) out.pixel_index[next + i] = first_index + start + i;
      out.companions.write(first_pixel + start, next, length);
      next += length;
    }
  });
}

}  // namespace
}  // namespace pc::images

PC_EXPORT int32_t pc_choose_pixels(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                   int64_t width, const float* column_rays, const float* row_rays, const float* rays,
                                   double near, double far, const uint8_t* mask, const double* matrices,
                                   const float* lower, const float* upper, uint8_t* keep, int64_t* readings,
                                   int64_t* starts, int64_t* possible) {
  using namespace pc;
  using namespace pc::images;
  return guarded([&] {
    const Images images{depth, views, height, width, column_rays, row_rays, rays};
    math::CropBox box{};
    for (int axis = 0; axis < 3 && lower != nullptr; ++axis) {
      box.lower[axis] = lower[axis];
      box.upper[axis] = upper[axis];
    }
    const Choice choice{static_cast<float>(near), static_cast<float>(far), mask, matrices,
                        lower == nullptr ? nullptr : &box};
    ScratchFrame scratch;
    auto* row_readings = scratch.take<int64_t>(images.rows());
    std::atomic<bool> all_possible{true};
    parallel_for(*context, images.rows(), kRowsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t row = first; row < last; ++row) {
        uint8_t* own = keep + row * width;
        row_readings[row] = choose_row(images, row, choice, own);
        if (row_readings[row] < 0) all_possible.store(false, std::memory_order_relaxed);
        int64_t kept = 0;
        for (int64_t u = 0; u < width; ++u) kept += own[u];
        starts[row + 1] = kept;
      }
    });
    *possible = all_possible;
    starts[0] = 0;
    for (int64_t row = 0; row < images.rows(); ++row) starts[row + 1] += starts[row];
    for (int64_t view = 0; view < views; ++view) {
      readings[view] = 0;
      for (int64_t v = 0; v < height; ++v) readings[view] += row_readings[view * height + v];
    }
  });
}

PC_EXPORT int32_t pc_deproject(const pc_context* context, const float* depth, int64_t views, int64_t height,
                               int64_t width, const float* column_rays, const float* row_rays, const float* rays,
                               const double* matrices, const uint8_t* keep, const int64_t* starts, float* points,
                               int64_t* pixel_index, int64_t over_all_views, const uint8_t* rgb, float* colors,
                               int64_t num_copied, const int64_t* sources, const int64_t* pixel_bytes,
                               const int64_t* copies) {
  using namespace pc;
  using namespace pc::images;
  return guarded([&] {
    const Images images{depth, views, height, width, column_rays, row_rays, rays};
    const Output out{
        starts, points, pixel_index, over_all_views != 0, {rgb, colors, num_copied, sources, pixel_bytes, copies}};
    parallel_for(*context, images.rows(), kRowsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      std::vector<rows::Run> runs(static_cast<size_t>(width + 1) / 2 + 1);
      for (int64_t row = first; row < last; ++row)
        write_row(images, row, keep + row * width, matrices, out, runs.data());
    });
  });
}

PC_EXPORT int32_t pc_mask_depth(const pc_context* context, const float* depth, int64_t count, double near, double far,
                                const uint8_t* mask, float* masked) {
  using namespace pc;
  using namespace pc::images;
  return guarded([&] {
    const float low = static_cast<float>(near), high = static_cast<float>(far);
    parallel_for(*context, count, 1 << 16, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t i = first; i < last; ++i) {
        const float z = depth[i];
        const bool keep = (z > 0) & (z >= low) & (z <= high) & (mask == nullptr || mask[i] != 0);
        masked[i] = keep ? z : 0.0F;
      }
    });
  });
}
