// Points as images: who is in front at every pixel.
#include <atomic>
#include <cmath>
#include <cstring>

#include "pc/math/camera.hpp"
#include "pc/math/triangle.hpp"
#include "pc/memory.hpp"
#include "pc/threads.hpp"

namespace pc::rendering {
namespace {

constexpr int64_t kRowsPerPiece = 4096;
constexpr int64_t kTrianglesPerPiece = 64;
constexpr int64_t kPixelsPerPiece = int64_t{1} << 16;
constexpr double kLargest = 65.0;  // pixels that a point is wide at most
constexpr uint64_t kEmpty = ~uint64_t{0};

// The depth above the row: the bits of positive floats are ordered as they are, so the smaller key is in front.
uint64_t key_of(float depth, int64_t row) {
  uint32_t bits;
  std::memcpy(&bits, &depth, sizeof bits);
  return uint64_t{bits} << 32 | static_cast<uint64_t>(row);
}

// The least of all keys that threads bring, whatever their order.
void bring(uint64_t* pixel, uint64_t key) {
  auto* shared = reinterpret_cast<std::atomic<uint64_t>*>(pixel);
  uint64_t seen = shared->load(std::memory_order_relaxed);
  while (key < seen && !shared->compare_exchange_weak(seen, key, std::memory_order_relaxed)) {}
}

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

// The first pixel center not left of a place, within an image of `size` pixels.
int64_t first_center(double place, int64_t size) {
  const double center = std::ceil(place), most = static_cast<double>(size);
  return static_cast<int64_t>(center < 0 ? 0.0 : center < most ? center : most);
}

void splat(const float* points, const CloudPiece& piece, const Cameras& cameras, double point_size, uint64_t* image) {
  const math::PinholeCamera camera = cameras.camera(piece.cloud);
  const math::Lens* lens = cameras.lens(piece.cloud);
  uint64_t* own = image + piece.cloud * cameras.height * cameras.width;
  for (int64_t i = piece.begin; i < piece.end; ++i) {
    const float* p = points + 3 * i;
    const math::Pixel at = camera.pixel(p[0], p[1], p[2], lens);
    if (!at.seen) continue;
    double half_width = point_size * camera.fx / p[2], half_height = point_size * camera.fy / p[2];
    half_width = (half_width < 1.0 ? 1.0 : half_width < kLargest ? half_width : kLargest) / 2;
    half_height = (half_height < 1.0 ? 1.0 : half_height < kLargest ? half_height : kLargest) / 2;
    const int64_t left = first_center(at.u - half_width, cameras.width);
    const int64_t right = first_center(at.u + half_width, cameras.width);
    const int64_t top = first_center(at.v - half_height, cameras.height);
    const int64_t bottom = first_center(at.v + half_height, cameras.height);
    const uint64_t key = key_of(p[2], i);
    for (int64_t v = top; v < bottom; ++v)
      for (int64_t u = left; u < right; ++u) bring(own + v * cameras.width + u, key);
  }
}

// Keys as depths and rows; nothing is depth 0 and row `missing`.
void read(const uint64_t* image, int64_t begin, int64_t end, int64_t missing, float* depth, int64_t* index) {
  for (int64_t i = begin; i < end; ++i) {
    const bool found = image[i] != kEmpty;
    const uint32_t bits = found ? static_cast<uint32_t>(image[i] >> 32) : 0;
    std::memcpy(depth + i, &bits, sizeof bits);
    index[i] = found ? static_cast<int64_t>(image[i] & 0xFFFFFFFFu) : missing;
  }
}

template <class Piece>
void z_buffer(const pc_context& context, int64_t pixels, int64_t missing, float* depth, int64_t* index,
              const std::vector<CloudPiece>& pieces, Piece&& bring_piece) {
  // The keys lie where the indices will.
  auto* image = reinterpret_cast<uint64_t*>(index);
  parallel_for(context, pixels, kPixelsPerPiece,
               [&](int64_t begin, int64_t end, int64_t) { std::fill(image + begin, image + end, kEmpty); });
  parallel_for(context, static_cast<int64_t>(pieces.size()), 1,
               [&](int64_t p, int64_t, int64_t) { bring_piece(pieces[static_cast<size_t>(p)], image); });
  parallel_for(context, pixels, kPixelsPerPiece,
               [&](int64_t begin, int64_t end, int64_t) { read(image, begin, end, missing, depth, index); });
}

}  // namespace
}  // namespace pc::rendering

PC_EXPORT int32_t pc_project_points(const pc_context* context, const double* points, const int64_t* ptr, int64_t views,
                                    const double* intrinsics, const double* lenses, double* pixels) {
  using namespace pc;
  using namespace pc::rendering;
  return guarded([&] {
    const Cameras cameras{intrinsics, lenses, 0, 0};
    const auto pieces = cut_clouds(ptr, views, kRowsPerPiece);
    for_each_piece(*context, pieces, kRowsPerPiece, [&](const CloudPiece& piece, int64_t) {
      const math::PinholeCamera camera = cameras.camera(piece.cloud);
      const math::Lens* lens = cameras.lens(piece.cloud);
      for (int64_t i = piece.begin; i < piece.end; ++i) {
        const math::Pixel at = camera.pixel(points[3 * i], points[3 * i + 1], points[3 * i + 2], lens);
        pixels[2 * i] = at.seen ? at.u : std::nan("");
        pixels[2 * i + 1] = at.seen ? at.v : std::nan("");
      }
    });
  });
}

PC_EXPORT int32_t pc_render_points(const pc_context* context, const float* points, const int64_t* ptr, int64_t views,
                                   const double* intrinsics, const double* lenses, int64_t height, int64_t width,
                                   double point_size, float* depth, int64_t* index) {
  using namespace pc;
  using namespace pc::rendering;
  return guarded([&] {
    const Cameras cameras{intrinsics, lenses, height, width};
    z_buffer(*context, views * height * width, ptr[views], depth, index, cut_clouds(ptr, views, kRowsPerPiece),
             [&](const CloudPiece& piece, uint64_t* image) { splat(points, piece, cameras, point_size, image); });
  });
}

PC_EXPORT int32_t pc_least_at_pixels(const pc_context* context, const float* value, const int64_t* pixel, int64_t rows,
                                     int64_t pixels, float* least, int64_t* index) {
  using namespace pc;
  using namespace pc::rendering;
  return guarded([&] {
    const int64_t ptr[2] = {0, rows};
    z_buffer(*context, pixels, rows, least, index, cut_clouds(ptr, 1, kRowsPerPiece),
             [&](const CloudPiece& piece, uint64_t* image) {
               for (int64_t i = piece.begin; i < piece.end; ++i)
                 if (pixel[i] >= 0) bring(image + pixel[i], key_of(value[i], i));
             });
  });
}

PC_EXPORT int32_t pc_front_triangles(const pc_context* context, const int64_t* first, const int64_t* across,
                                     const int64_t* down, int64_t triangles, int64_t width, const double* rays,
                                     int64_t pixels, const double* normals, const double* offsets, const double* sides,
                                     float* depth, int64_t* index, float* weights) {
  using namespace pc;
  using namespace pc::rendering;
  return guarded([&] {
    const auto meet = [&](int64_t triangle, int64_t pixel) {
      return math::meet(normals + 3 * triangle, offsets[triangle], sides + 9 * triangle, rays[2 * pixel],
                        rays[2 * pixel + 1]);
    };
    const int64_t ptr[2] = {0, triangles};
    z_buffer(*context, pixels, triangles, depth, index, cut_clouds(ptr, 1, kTrianglesPerPiece),
             [&](const CloudPiece& piece, uint64_t* image) {
               for (int64_t t = piece.begin; t < piece.end; ++t)
                 for (int64_t row = 0; row < down[t]; ++row)
                   for (int64_t column = 0; column < across[t]; ++column) {
                     const int64_t pixel = first[t] + (row * width + column);
                     const double at = meet(t, pixel).depth;
                     if (at > 0) bring(image + pixel, key_of(static_cast<float>(at), t));
                   }
             });
    parallel_for(*context, pixels, kPixelsPerPiece, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t pixel = begin; pixel < end; ++pixel) {
        const bool found = index[pixel] < triangles;
        const math::Meeting met = found ? meet(index[pixel], pixel) : math::Meeting{};
        depth[pixel] = static_cast<float>(met.depth);
        for (int corner = 0; corner < 3; ++corner)
          weights[3 * pixel + corner] = found ? static_cast<float>(met.weight(corner)) : 0.0F;
      }
    });
  });
}
