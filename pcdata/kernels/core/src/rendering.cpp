// Points and triangles as images: who is in front at every pixel.
#include <cmath>

#include "pc/images/splats.hpp"
#include "pc/math/triangle.hpp"

namespace pc::rendering {
namespace {

using images::Cameras;
using images::Splats;
using images::ZBuffer;

constexpr int64_t kRowsPerPiece = 4096;
constexpr int64_t kTrianglesPerPiece = 64;

template <class Pixels>
void draw_points(const float* points, const CloudPiece& piece, const Cameras& cameras, double point_size,
                 const Pixels& pixels) {
  images::for_splats(points, piece, cameras, point_size, [&](const Splats& splats, int count, int64_t first) {
    for (int i = 0; i < count; ++i) {
      const uint64_t key = images::front_key(splats.z(i), first + i);
      for (int64_t v = splats.top[i]; v < splats.bottom[i]; ++v)
        for (int64_t u = splats.left[i]; u < splats.right[i]; ++u) pixels.bring(v * cameras.width + u, key);
    }
  });
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
    const ZBuffer image{*context, views, height * width, depth, index};
    if (point_size > 0 && views < 4 * int64_t{context->threads}) {
      image.clear();
      images::BandDrawing(image, cameras).run(points, ptr, point_size);
      return image.read(ptr[views]);
    }
    image.run(ptr, ptr[views], kRowsPerPiece, [&](const CloudPiece& piece, const auto& pixels) {
      draw_points(points, piece, cameras, point_size, pixels);
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
    const ZBuffer image{*context, 1, pixels, depth, index};
    image.run(ptr, triangles, kTrianglesPerPiece, [&](const CloudPiece& piece, const auto& shared) {
      for (int64_t t = piece.begin; t < piece.end; ++t)
        for (int64_t row = 0; row < down[t]; ++row)
          for (int64_t column = 0; column < across[t]; ++column) {
            const int64_t pixel = first[t] + (row * width + column);
            const double at = meet(t, pixel).depth;
            if (at > 0) shared.bring(pixel, images::front_key(static_cast<float>(at), t));
          }
    });
    parallel_for(*context, pixels, images::kPixelsPerPiece, [&](int64_t begin, int64_t end, int64_t) {
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
