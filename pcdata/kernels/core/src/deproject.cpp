// Depth images to points, with what other images say about the same pixels.
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

// What goes along with the points: RGB images become float colours, other images are copied pixel by pixel. All images
// are (views, height, width, ...); a null pointer means that there is none.
struct Companions {
  const uint8_t* rgb;
  float* colors;  // (M, 3), in [0, 1]
  int64_t num_copied;
  const int64_t* sources;      // addresses of the images
  const int64_t* pixel_bytes;
  const int64_t* copies;       // addresses of their rows, (M, ...)

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

// Write the points of one image row, run by run of readings: within a run there is nothing to decide. `ray(u)` gives
// x/z and y/z.
template <class Ray>
void write_row(const Images& images, int64_t row, const Output& out, const Ray& ray) {
  const float* depth = images.depth + row * images.width;
  const int64_t first_pixel = row * images.width;
  const int64_t first_index = (out.over_all_views ? row : row % images.height) * images.width;
  int64_t next = out.starts[row];
  for (int64_t u = 0; u < images.width;) {
    while (u < images.width && !(depth[u] > 0)) ++u;
    int64_t end = u;
    while (end < images.width && depth[end] > 0) ++end;
    if (end == u) break;
    float* points = out.points + 3 * (next - u);
    for (int64_t i = u; i < end; ++i) {
      const float z = depth[i];
      const auto [x, y] = ray(i);
      points[3 * i] = x * z;
      points[3 * i + 1] = y * z;
      points[3 * i + 2] = z;
    }
    for (int64_t i = u; i < end; ++i) out.pixel_index[next - u + i] = first_index + i;
    out.companions.write(first_pixel + u, next, end - u);
    next += end - u;
    u = end;
  }
}

struct Direction {
  float x, y;
};

}  // namespace
}  // namespace pc

// depth (views, height, width) -> starts (views * height + 1,): where the points of each image row start. *possible
// becomes 0 if a depth is negative or not a number.
PC_EXPORT int32_t pc_count_readings(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                    int64_t width, int64_t* starts, int64_t* possible) {
  return pc::guarded([&] {
    const pc::Images images{depth, views, height, width};
    starts[0] = 0;
    *possible = pc::count_readings(*context, images, starts + 1);
    for (int64_t row = 0; row < images.rows(); ++row) starts[row + 1] += starts[row];
  });
}

// depth -> points (M, 3), pixel_index (M,), and the rows of the companions. The rays are those of pinhole cameras
// without distortion: column_rays (views, width) is x/z of every column and row_rays (views, height) y/z of every image
// row; or, where these are null, rays (views, height, width, 2) is x/z and y/z of every pixel.
PC_EXPORT int32_t pc_deproject(const pc_context* context, const float* depth, int64_t views, int64_t height,
                               int64_t width, const float* column_rays, const float* row_rays, const float* rays,
                               const int64_t* starts, float* points, int64_t* pixel_index, int64_t over_all_views,
                               const uint8_t* rgb, float* colors, int64_t num_copied, const int64_t* sources,
                               const int64_t* pixel_bytes, const int64_t* copies) {
  return pc::guarded([&] {
    const pc::Images images{depth, views, height, width};
    const pc::Output out{starts, points, pixel_index, over_all_views != 0,
                         {rgb, colors, num_copied, sources, pixel_bytes, copies}};
    pc::parallel_for(*context, images.rows(), pc::kRowsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t row = first; row < last; ++row) {
        if (rays != nullptr) {
          const float* ray = rays + 2 * row * width;
          pc::write_row(images, row, out, [ray](int64_t u) { return pc::Direction{ray[2 * u], ray[2 * u + 1]}; });
        } else {
          const float* x = column_rays + row / height * width;
          const float y = row_rays[row];
          pc::write_row(images, row, out, [x, y](int64_t u) { return pc::Direction{x[u], y}; });
        }
      }
    });
  });
}
