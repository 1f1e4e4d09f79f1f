// Depth images rendered as color cameras see them: project every reading, paint its cell into a z-buffer, and say
// which readings the color camera does not see. The float32 operations are the reference's, in its order.
#include <cmath>
#include <cstring>
#include <limits>

#include "pc/images/projection.hpp"
#include "pc/memory.hpp"
#include "pc/threads.hpp"

namespace pc::images {
namespace {

constexpr int64_t kDepthRowsPerPiece = 64;  // of the depth image: two more are projected for every piece
constexpr int64_t kColorPixelsPerPiece = 1 << 16;
constexpr uint64_t kEmpty = ~uint64_t{0};  // as an index: -1

// The corners above or below a row of pixels, outer ones included; each (width + 1,).
struct CellCorners {
  float *u, *v;
  int32_t* linked;  // the four pixels around lie on one surface

  static constexpr int64_t kArrays = 3;
  CellCorners(float* room, int64_t width)
      : u(room), v(room + (width + 1)), linked(reinterpret_cast<int32_t*>(room + 2 * (width + 1))) {}
};

// The color pixels that a row of depth pixels covers, ends excluded; each (width,).
struct PixelCells {
  int32_t *left, *right, *top, *bottom;

  static constexpr int64_t kArrays = 4;
  PixelCells(int32_t* room, int64_t width)
      : left(room), right(room + width), top(room + 2 * width), bottom(room + 3 * width) {}
};

// The mean coordinates at the inner corners between two rows of pixels.
void average(const float* __restrict above, const float* __restrict below, int64_t width, float* __restrict corners) {
  for (int64_t i = 0; i + 1 < width; ++i)
    corners[i] = math::corner_between(above[i], above[i + 1], below[i], below[i + 1]);
}

// The corners between two rows of pixels; the outer ones keep what they are, not linked.
void link(const ProjectedRow& seen_above, const ProjectedRow& seen_below, int64_t width, float max_jump,
          const CellCorners& corners) {
  average(seen_above.u, seen_below.u, width, corners.u + 1);
  average(seen_above.v, seen_below.v, width, corners.v + 1);
  const float* __restrict above = seen_above.reading;
  const float* __restrict below = seen_below.reading;
  int32_t* __restrict linked = corners.linked + 1;
  for (int64_t i = 0; i + 1 < width; ++i)
    linked[i] = math::on_one_surface(above[i], below[i], above[i + 1], below[i + 1], max_jump);
}

// One coordinate's ends of a row of cells, from the corners above and below, cut to [0, limit).
void cut_cells(const float* __restrict center, const float* __restrict half, const float* __restrict above,
               const float* __restrict below, const CellCorners& upper_corners, const CellCorners& lower_corners,
               int64_t width, int64_t limit, int32_t* __restrict first, int32_t* __restrict end) {
  constexpr float kInfinity = std::numeric_limits<float>::infinity();
  const float most = static_cast<float>(limit);
  const int32_t* __restrict linked_above = upper_corners.linked;
  const int32_t* __restrict linked_below = lower_corners.linked;
  for (int64_t i = 0; i < width; ++i) {
    const int32_t a = linked_above[i], b = linked_above[i + 1], c = linked_below[i], d = linked_below[i + 1];
    float low = kInfinity, high = -kInfinity;
    low = math::lower(low, a ? above[i] : kInfinity);
    high = math::upper(high, a ? above[i] : -kInfinity);
    low = math::lower(low, b ? above[i + 1] : kInfinity);
    high = math::upper(high, b ? above[i + 1] : -kInfinity);
    low = math::lower(low, c ? below[i] : kInfinity);
    high = math::upper(high, c ? below[i] : -kInfinity);
    low = math::lower(low, d ? below[i + 1] : kInfinity);
    high = math::upper(high, d ? below[i + 1] : -kInfinity);
    const float reach = (a & b & c & d) ? -kInfinity : half[i];  // reaches nowhere
    low = math::lower(low, center[i] - reach);
    high = math::upper(high, center[i] + reach);
    first[i] = static_cast<int32_t>(math::lower(math::upper(std::ceil(low), 0.0F), most));
    end[i] = static_cast<int32_t>(math::lower(math::upper(std::ceil(high), 0.0F), most));
  }
}

// The nearest reading of every color pixel so far: the bits of its depth, which are ordered as positive floats are,
// above its index. The smallest stays, so the order of painting does not matter.
struct KeyBuffer {
  uint64_t* nearest;
  int64_t height, width;
  bool shared;  // by several threads

  void put(uint64_t* pixel, uint64_t key) const {
    uint64_t found = __atomic_load_n(pixel, __ATOMIC_RELAXED);
    if (!shared) {
      if (key < found) *pixel = key;
      return;
    }
    while (key < found && !__atomic_compare_exchange_n(pixel, &found, key, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
  }
  void paint_row(const ProjectedRow& seen, const PixelCells& cells, int64_t count, uint64_t first_index) const {
    for (int64_t i = 0; i < count; ++i) {
      if (!(seen.reading[i] > 0)) continue;
      uint32_t bits;
      std::memcpy(&bits, seen.z + i, sizeof(bits));
      const uint64_t key = uint64_t{bits} << 32 | (first_index + static_cast<uint64_t>(i));
      for (int64_t v = cells.top[i]; v < cells.bottom[i]; ++v)
        for (int64_t u = cells.left[i]; u < cells.right[i]; ++u) put(nearest + v * width + u, key);
    }
  }
};

// What one thread needs for its rows: two of pixels and two of corners at a time, which stay in the cache.
struct RowBuffers {
  ProjectedRow seen[2];
  CellCorners corners[2];
  PixelCells cells;

  static int64_t size(int64_t width) { return cells_start(width) + PixelCells::kArrays * width; }
  RowBuffers(float* room, int64_t width)
      : seen{{room, width}, {room + ProjectedRow::kArrays * width, width}},
        corners{{room + corners_start(width), width},
                {room + corners_start(width) + CellCorners::kArrays * (width + 1), width}},
        cells(reinterpret_cast<int32_t*>(room + cells_start(width)), width) {}

 private:
  static int64_t corners_start(int64_t width) { return 2 * ProjectedRow::kArrays * width; }
  static int64_t cells_start(int64_t width) { return corners_start(width) + 2 * CellCorners::kArrays * (width + 1); }
};

// Paint the rows [first, last) of a view. Returns false where `project` does.
bool paint_rows(const DepthView& view, int64_t first, int64_t last, float max_jump, const KeyBuffer& buffer,
                const RowBuffers& own) {
  const int64_t width = view.width;
  bool possible = true;
  for (const CellCorners& corners : own.corners) std::fill_n(corners.linked, width + 1, 0);
  if (first > 0) {
    possible &= project(view, first - 1, own.seen[(first - 1) & 1]);
    possible &= project(view, first, own.seen[first & 1]);
    link(own.seen[(first - 1) & 1], own.seen[first & 1], width, max_jump, own.corners[(first - 1) & 1]);
  } else {
    possible &= project(view, 0, own.seen[0]);
  }
  for (int64_t row = first; row < last; ++row) {
    const ProjectedRow& seen = own.seen[row & 1];
    const CellCorners& above = own.corners[(row - 1) & 1];
    const CellCorners& below = own.corners[row & 1];
    if (row + 1 < view.height) {
      possible &= project(view, row + 1, own.seen[(row + 1) & 1]);
      link(seen, own.seen[(row + 1) & 1], width, max_jump, below);
    } else {
      std::fill_n(below.linked, width + 1, 0);
    }
    if (!possible) return false;
    cut_cells(seen.u, seen.half_width, above.u, below.u, above, below, width, buffer.width, own.cells.left,
              own.cells.right);
    cut_cells(seen.v, seen.half_height, above.v, below.v, above, below, width, buffer.height, own.cells.top,
              own.cells.bottom);
    buffer.paint_row(seen, own.cells, width, static_cast<uint64_t>(row * width));
  }
  return true;
}

// Keys to depths, 0 where nothing was painted, and, in their place, indices.
void read_keys(uint64_t* __restrict keys, float* __restrict depth, int64_t first, int64_t last) {
  for (int64_t i = first; i < last; ++i) {
    const uint64_t key = keys[i];
    const uint32_t bits = key == kEmpty ? 0 : static_cast<uint32_t>(key >> 32);
    std::memcpy(depth + i, &bits, sizeof(bits));
    keys[i] = key == kEmpty ? kEmpty : key & 0xFFFFFFFFU;
  }
}

// Say which readings of a row the color camera does not see, and where a nearer surface is why.
void find_hidden(const DepthView& view, int64_t row, const float* registered, int64_t color_height, int64_t color_width,
                 float farthest, const RowBuffers& own, uint8_t* hidden, uint8_t* occluding) {
  const ProjectedRow& seen = own.seen[0];
  project(view, row, seen);
  const float* depth = view.depth + row * view.width;
  int32_t* __restrict columns = own.cells.left;
  int32_t* __restrict rows = own.cells.top;
  const float* __restrict seen_u = seen.u;
  const float* __restrict seen_v = seen.v;
  const float* __restrict reading = seen.reading;
  const float width = static_cast<float>(color_width), height = static_cast<float>(color_height);
  for (int64_t i = 0; i < view.width; ++i) {
    const float u = std::floor(seen_u[i] + 0.5F), v = std::floor(seen_v[i] + 0.5F);
    const bool inside = (reading[i] > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height);
    columns[i] = inside ? static_cast<int32_t>(u) : -1;
    rows[i] = inside ? static_cast<int32_t>(v) : -1;
  }
  for (int64_t i = 0; i < view.width; ++i) {
    if (columns[i] < 0) {
      hidden[i] = depth[i] > 0;
      continue;
    }
    const int64_t target = rows[i] * color_width + columns[i];
    const float front = registered[target];
    hidden[i] = (front > 0) & (seen.z[i] > farthest * front);
    if (hidden[i]) __atomic_store_n(occluding + target, uint8_t{1}, __ATOMIC_RELAXED);
  }
}

}  // namespace
}  // namespace pc::images

PC_EXPORT int32_t pc_register_depth(const pc_context* context, const float* depth, int64_t views, int64_t height,
                                    int64_t width, const float* column_rays, const float* row_rays, const float* rays,
                                    const double* color_from_depth, const double* color_intrinsics,
                                    const double* half_pixels, const double* lenses, int64_t color_height,
                                    int64_t color_width, double max_jump, float* registered, int64_t* pixel_index,
                                    uint8_t* occluding, uint8_t* hidden, int64_t* possible) {
  using namespace pc;
  using namespace pc::images;
  return guarded([&] {
    const int64_t pixels = height * width, color_pixels = color_height * color_width;
    const int64_t threads = std::max<int64_t>(1, context->threads);
    const float jump = static_cast<float>(max_jump), farthest = static_cast<float>(1 + max_jump);
    ScratchFrame scratch;
    std::vector<RowBuffers> rows_of_threads;
    for (int64_t t = 0; t < threads; ++t)
      rows_of_threads.emplace_back(scratch.take<float>(RowBuffers::size(width)), width);
    std::atomic<bool> all_possible{true};
    for (int64_t number = 0; number < views && all_possible; ++number) {
      math::Lens lens{};
      if (lenses != nullptr) std::memcpy(&lens, lenses + 14 * number, sizeof(lens));
      DepthView view{depth + number * pixels, height, width};
      if (rays != nullptr) {
        view.rays = rays + 2 * number * pixels;
      } else {
        view.column_rays = column_rays + number * width;
        view.row_rays = row_rays + number * height;
      }
      view.camera = math::ColorCamera::of(color_from_depth + 16 * number, color_intrinsics + 9 * number,
                                          half_pixels + 2 * number);
      view.lens = lenses == nullptr ? nullptr : &lens;

      float* image = registered + number * color_pixels;
      auto* keys = reinterpret_cast<uint64_t*>(pixel_index + number * color_pixels);
      uint8_t* marks = occluding + number * color_pixels;
      const KeyBuffer buffer{keys, color_height, color_width, threads > 1};
      parallel_for(*context, color_pixels, kColorPixelsPerPiece, [&](int64_t first, int64_t last, int64_t) {
        std::fill(keys + first, keys + last, kEmpty);
        std::fill(marks + first, marks + last, uint8_t{0});
      });
      parallel_for(*context, height, kDepthRowsPerPiece, [&](int64_t first, int64_t last, int64_t thread) {
        if (!paint_rows(view, first, last, jump, buffer, rows_of_threads[static_cast<size_t>(thread)]))
          all_possible.store(false, std::memory_order_relaxed);
      });
      parallel_for(*context, color_pixels, kColorPixelsPerPiece,
                   [&](int64_t first, int64_t last, int64_t) { read_keys(keys, image, first, last); });
      parallel_for(*context, height, kDepthRowsPerPiece, [&](int64_t first, int64_t last, int64_t thread) {
        for (int64_t row = first; row < last; ++row)
          find_hidden(view, row, image, color_height, color_width, farthest,
                      rows_of_threads[static_cast<size_t>(thread)], hidden + number * pixels + row * width, marks);
      });
    }
    *possible = all_possible;
  });
}
