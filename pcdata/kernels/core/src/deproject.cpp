// Depth images to points.
#include "pc/common.hpp"

namespace pc {
namespace {

constexpr int64_t kRowsPerPiece = 16;

// Depth images (views, height, width) and the readings found in them, row by row.
struct Images {
  const float* depth;
  int64_t views, height, width;

  int64_t rows() const { return views * height; }
};

// Counts[r] becomes the number of readings in image row r; returns false if a depth is negative or not a number.
bool count_readings(const pc_context& context, const Images& images, int64_t* counts) {
  std::atomic<bool> possible{true};
  parallel_for(context, images.rows(), kRowsPerPiece, [&](int64_t first, int64_t last, int64_t) {
    for (int64_t row = first; row < last; ++row) {
      const float* depth = images.depth + row * images.width;
      int32_t readings = 0, wrong = 0;
      for (int64_t u = 0; u < images.width; ++u) {
        readings += depth[u] > 0;
        wrong |= !(depth[u] >= 0);
      }
      counts[row] = readings;
      if (wrong != 0) possible.store(false, std::memory_order_relaxed);
    }
  });
  return possible;
}

// Where a row's points go.
struct Output {
  float* points;        // (M, 3)
  int64_t* pixel_index;  // (M,)
};

// Write the points of one image row, run by run of readings: within a run there is nothing to decide. `ray(u)` gives
// x/z and y/z.
template <class Ray>
void write_row(const float* depth, int64_t width, int64_t first_pixel, Output out, const Ray& ray) {
  for (int64_t u = 0; u < width;) {
    while (u < width && !(depth[u] > 0)) ++u;
    int64_t end = u;
    while (end < width && depth[end] > 0) ++end;
    for (int64_t i = u; i < end; ++i) {
      const float z = depth[i];
      const auto [x, y] = ray(i);
      float* p = out.points + 3 * (i - u);
      p[0] = x * z;
      p[1] = y * z;
      p[2] = z;
      out.pixel_index[i - u] = first_pixel + i;
    }
    out.points += 3 * (end - u);
    out.pixel_index += end - u;
    u = end;
  }
}

struct Direction {
  float x, y;
};

}  // namespace
}  // namespace pc

// depth (views, height, width) -> starts (views * height + 1,): where the points of each image row start. *possible
// becomes 0 if a depth is negative or not finite.
PC_EXPORT int32_t pc_count_readings(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                    int64_t width, int64_t* starts, int64_t* possible) {
  return pc::guarded([&] {
    const pc::Images images{depth, views, height, width};
    starts[0] = 0;
    *possible = pc::count_readings(*context, images, starts + 1);
    for (int64_t row = 0; row < images.rows(); ++row) starts[row + 1] += starts[row];
  });
}

// Pinhole cameras without distortion. row_rays (views, height) is y/z of every image row and column_rays (views, width)
// x/z of every column -> points (M, 3), pixel_index (M,).
PC_EXPORT int32_t pc_deproject_pinhole(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                       int64_t width, const float* column_rays, const float* row_rays,
                                       const int64_t* starts, float* points, int64_t* pixel_index) {
  return pc::guarded([&] {
    const pc::Images images{depth, views, height, width};
    pc::parallel_for(*context, images.rows(), pc::kRowsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t row = first; row < last; ++row) {
        const float* x = column_rays + row / height * width;
        const float y = row_rays[row];
        pc::write_row(depth + row * width, width, row % height * width,
                      {points + 3 * starts[row], pixel_index + starts[row]},
                      [x, y](int64_t u) { return pc::Direction{x[u], y}; });
      }
    });
  });
}

// Any cameras: rays (views, height, width, 2) are x/z and y/z of every pixel.
PC_EXPORT int32_t pc_deproject_rays(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                    int64_t width, const float* rays, const int64_t* starts, float* points,
                                    int64_t* pixel_index) {
  return pc::guarded([&] {
    const pc::Images images{depth, views, height, width};
    pc::parallel_for(*context, images.rows(), pc::kRowsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t row = first; row < last; ++row) {
        const float* ray = rays + 2 * row * width;
        pc::write_row(depth + row * width, width, row % height * width,
                      {points + 3 * starts[row], pixel_index + starts[row]},
                      [ray](int64_t u) { return pc::Direction{ray[2 * u], ray[2 * u + 1]}; });
      }
    });
  });
}
