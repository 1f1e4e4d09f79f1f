// Range images of spinning lidars, both ways. Directions are compared by quotients that rise with their angles, so that
// nothing but arithmetic decides.
#include <cmath>

#include "pc/images/borders.hpp"
#include "pc/images/z_buffer.hpp"

namespace pc::ranges {
namespace {

constexpr int64_t kRowsPerPiece = 4096;

struct Lidar {
  int64_t beams, columns;
  images::Borders rows, turns;

  // The pixel of a point and its distance; -1 = none.
  int64_t pixel(const float* point, float& distance) const {
    const double x = point[0], y = point[1], z = point[2];
    const double flat = std::sqrt(x * x + y * y);
    const double range = std::sqrt((x * x + y * y) + z * z);
    distance = static_cast<float>(range);
    if (!(distance > 0)) return -1;
    const int64_t row = rows.count_upto(-z / (flat + std::fabs(z))) - 1;
    if (row < 0 || row >= beams) return -1;
    const double across = std::fabs(x) + std::fabs(y);
    const double turn = across > 0 ? x / across : 1.0;  // straight up is where straight ahead is
    return row * columns + turns.count_upto(y >= 0 ? turn + 1 : 3 - turn);
  }
};

}  // namespace
}  // namespace pc::ranges

PC_EXPORT int32_t pc_render_ranges(const pc_context* context, const float* points, const int64_t* ptr, int64_t views,
                                   int64_t beams, int64_t columns, const double* row_borders,
                                   const double* column_borders, float* depth, int64_t* index) {
  using namespace pc;
  using namespace pc::ranges;
  return guarded([&] {
    const Lidar lidar{beams, columns, {row_borders, beams + 1, -1, 1}, {column_borders, columns - 1, 0, 4}};
    const images::ZBuffer image{*context, views, beams * columns, depth, index};
    image.run(ptr, ptr[views], kRowsPerPiece, [&](const CloudPiece& piece, const auto& pixels) {
      for (int64_t i = piece.begin; i < piece.end; ++i) {
        float distance;
        const int64_t pixel = lidar.pixel(points + 3 * i, distance);
        if (pixel >= 0) pixels.bring(pixel, images::front_key(distance, i));
      }
    });
  });
}

PC_EXPORT int32_t pc_deproject_ranges(const pc_context* context, const float* ranges, int64_t views, int64_t beams,
                                      int64_t columns, const int64_t* starts, const double* row_turns,
                                      const double* column_turns, float* points, int64_t* pixel_index) {
  using namespace pc;
  constexpr int64_t kPixelsPerPiece = int64_t{1} << 14;
  return guarded([&] {
    const int64_t grain = std::max<int64_t>(1, kPixelsPerPiece / std::max<int64_t>(columns, 1));
    parallel_for(*context, views * beams, grain, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t row = begin; row < end; ++row) {
        const int64_t beam = row % beams;
        const double* up = row_turns + 2 * beam;
        int64_t to = starts[row];
        for (int64_t column = 0; column < columns; ++column) {
          const float range = ranges[row * columns + column];
          if (!(range > 0)) continue;
          const double* own = column_turns + 2 * column;
          points[3 * to] = static_cast<float>((up[0] * own[0]) * static_cast<double>(range));
          points[3 * to + 1] = static_cast<float>((up[0] * own[1]) * static_cast<double>(range));
          points[3 * to + 2] = static_cast<float>(up[1] * static_cast<double>(range));
          pixel_index[to++] = beam * columns + column;
        }
      }
    });
  });
}
