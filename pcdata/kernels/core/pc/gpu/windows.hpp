// Searches of clouds on depth images: the window of pixels around a point, ring by ring, until nothing outside can
// matter. Points without a proof are listed, and left to the tree of boxes.
#pragma once

#include "pc/gpu/cell_table.hpp"
#include "pc/gpu/nearest.hpp"
#include "pc/gpu/organized.hpp"

namespace pc::gpu {

struct Windows {
  PixelImage image;
  const float* points;   // (N, 3)
  const float* sides;    // as pc_bound_sides leaves them
  const int32_t* unfit;  // (clouds)
  const int64_t* ptr;    // (clouds + 1)
  const int64_t* pixel;  // (N)
};

// A point at its pixel, and what lies around it.
struct Window {
  const Windows& all;
  int64_t row, cloud, u, v;
  const Placed* middle;
  math::Point at;  // in the camera's frame

  PC_HD Window(const Windows& windows, int64_t of_row) : all(windows), row(of_row) {
    cloud = cloud_of(all.ptr, all.image.clouds, row);
    v = all.pixel[row] / all.image.width;
    u = all.pixel[row] - v * all.image.width;
    middle = all.image.placed + cloud * all.image.pixels() + all.pixel[row];
    at = all.image.in_camera(cloud, middle->x, middle->y, middle->z);
  }

  // Call body(squared distance, row) for the points of the ring at this distance in pixels.
  template <class Body>
  PC_HD void for_ring(int64_t ring, Body&& body) const {
    for (int64_t dv = -ring; dv <= ring; ++dv) {
      if (v + dv < 0 || v + dv >= all.image.height) continue;
      const int64_t step = dv == -ring || dv == ring || ring == 0 ? 1 : 2 * ring;
      for (int64_t du = -ring; du <= ring; du += step) {
        if (u + du < 0 || u + du >= all.image.width) continue;
        const Placed p = middle[dv * all.image.width + du];
        if (p.row >= 0) body(math::squared_distance(p.x, p.y, p.z, middle->x, middle->y, middle->z), p.row);
      }
    }
  }

  // The squared distance within which every point lies in the window of this half-width; below 0: not known.
  PC_HD float clear_within(int64_t reach) const {
    if (all.unfit[cloud] != 0) return -1;
    const int64_t width = all.image.width, height = all.image.height;
    const float* columns = all.sides + cloud * 4 * (width + height);
    const float* lines = columns + 4 * width;
    float side = float_of(0x7F800000u);
    side = nearer(side, columns, width, u, reach, at.x);
    side = nearer(side, lines, height, v, reach, at.y);
    return math::squared_clearance(side - math::rounding_slack(at.x, at.y, at.z));
  }

 private:
  // The distance to the half-spaces on both sides along one axis, or what it was.
  PC_HD float nearer(float side, const float* half_spaces, int64_t count, int64_t place, int64_t reach,
                     float coordinate) const {
    const int64_t after = place + reach + 1, before = place - reach - 1;
    if (after < count) {
      const float* plane = half_spaces + 2 * after;
      const float to = plane[1] * at.z - plane[0] * coordinate;
      side = to < side ? to : side;
    }
    if (before >= 0) {
      const float* plane = half_spaces + 2 * (count + before);
      const float to = plane[0] * coordinate - plane[1] * at.z;
      side = to < side ? to : side;
    }
    return side;
  }
};

constexpr int64_t kMoreRings = 8;  // beyond those that hold as many pixels as are wanted

#define PC_WINDOWS_PARAMETERS                                                                             \
  PC_IMAGE_PARAMETERS, const float *points, const float *sides, const int32_t *unfit, const int64_t *ptr, \
      const int64_t *pixel, int64_t rows, int64_t *rest, int32_t *num_rest
#define PC_WINDOWS \
  PC_IMAGE;        \
  const Windows windows { image, points, sides, unfit, ptr, pixel }

// Find the nearest of one row; say whether they are proved to be.
template <class Keys>
PC_HD bool search_window(const Window& window, int64_t k, float limit, Keys& keys) {
  const uint64_t most = key_of(limit, -1);
  const auto offer_ring = [&](int64_t ring) {
    window.for_ring(ring, [&](float squared, int32_t row) {
      const uint64_t key = key_of(squared, row), last = keys.last();
      if (key < last && key <= most) keys.offer(key);
    });
  };
  const auto bound = [&] {
    const uint64_t last = keys.last();
    return last == kNoKey || squared_of(last) > limit ? limit : squared_of(last);
  };
  int64_t reach = 0;
  offer_ring(0);
  while ((2 * reach + 1) * (2 * reach + 1) < k) offer_ring(++reach);
  const int64_t largest = reach + kMoreRings;
  for (;;) {
    const float wanted = bound(), clear = window.clear_within(reach);
    if (wanted < clear || clear == float_of(0x7F800000u)) return true;  // infinite: that is the whole image
    if (reach == largest || !(wanted < window.clear_within(largest) || keys.last() == kNoKey)) return false;
    offer_ring(++reach);
  }
}

template <int kMost, class Tell>
PC_HD void find_in_window(const Windows& windows, int64_t rows, int64_t k, double limit, int64_t* rest,
                          int32_t* num_rest, const Tell& tell) {
  const int64_t row = thread_index();
  if (row >= filled(windows.ptr, windows.image.clouds, rows)) return;
  const Window window(windows, row);
  FewKeys<kMost> keys;
  keys.start(k);
  if (search_window(window, k, static_cast<float>(limit), keys))
    tell(keys, row, Query{window.middle->x, window.middle->y, window.middle->z, 0, 0, 0});
  else
    rest[atomic_add(num_rest, 1)] = row;
}

PC_KERNEL(pc_window_nearest_8, PC_WINDOWS_PARAMETERS, int64_t k, double limit, int64_t missing, int64_t* index,
          float* told, int64_t squares) {
  PC_WINDOWS;
  find_in_window<8>(windows, rows, k, limit, rest, num_rest, Neighbors{k, missing, index, told, squares != 0});
}
PC_KERNEL(pc_window_nearest_16, PC_WINDOWS_PARAMETERS, int64_t k, double limit, int64_t missing, int64_t* index,
          float* told, int64_t squares) {
  PC_WINDOWS;
  find_in_window<16>(windows, rows, k, limit, rest, num_rest, Neighbors{k, missing, index, told, squares != 0});
}
PC_KERNEL(pc_window_nearest_32, PC_WINDOWS_PARAMETERS, int64_t k, double limit, int64_t missing, int64_t* index,
          float* told, int64_t squares) {
  PC_WINDOWS;
  find_in_window<32>(windows, rows, k, limit, rest, num_rest, Neighbors{k, missing, index, told, squares != 0});
}
PC_KERNEL(pc_window_nearest_64, PC_WINDOWS_PARAMETERS, int64_t k, double limit, int64_t missing, int64_t* index,
          float* told, int64_t squares) {
  PC_WINDOWS;
  find_in_window<64>(windows, rows, k, limit, rest, num_rest, Neighbors{k, missing, index, told, squares != 0});
}
PC_KERNEL(pc_window_mean_distances_32, PC_WINDOWS_PARAMETERS, int64_t k, double limit, double* mean) {
  PC_WINDOWS;
  find_in_window<32>(windows, rows, k, limit, rest, num_rest, MeanDistance{k, mean});
}
PC_KERNEL(pc_window_mean_distances_64, PC_WINDOWS_PARAMETERS, int64_t k, double limit, double* mean) {
  PC_WINDOWS;
  find_in_window<64>(windows, rows, k, limit, rest, num_rest, MeanDistance{k, mean});
}
PC_KERNEL(pc_window_normals_32, PC_WINDOWS_PARAMETERS, int64_t k, double limit, float* normals) {
  PC_WINDOWS;
  find_in_window<32>(windows, rows, k, limit, rest, num_rest, Normal{k, points, normals});
}
PC_KERNEL(pc_window_normals_64, PC_WINDOWS_PARAMETERS, int64_t k, double limit, float* normals) {
  PC_WINDOWS;
  find_in_window<64>(windows, rows, k, limit, rest, num_rest, Normal{k, points, normals});
}

// Mark the rows with at most `enough` points nearer than a radius, itself among them. Sets `far` (1,) as
// pc_insert_cells does for cells of that side.
PC_KERNEL(pc_count_in_windows, PC_WINDOWS_PARAMETERS, double limit, int64_t enough, double side, uint8_t* outlier,
          int32_t* far) {
  const int64_t row = thread_index();
  PC_WINDOWS;
  if (row >= filled(ptr, clouds, rows)) return;
  const Window window(windows, row);
  if (NeighborCells{points, ptr, clouds, side}.is_far(window.cloud, points + 3 * row)) *far = 1;
  const float below = static_cast<float>(limit);
  int64_t found = 0, reach = 0;
  for (;; ++reach) {
    window.for_ring(reach, [&](float squared, int32_t) { found += squared < below; });
    outlier[row] = found <= enough;
    if (found > enough || below <= window.clear_within(reach)) return;
    if (reach == kMoreRings) break;
  }
  rest[atomic_add(num_rest, 1)] = row;
}

// Counts keys up to one more than enough.
struct KeyCount {
  int64_t counted, enough;

  PC_HD uint64_t last() const { return counted > enough ? 0 : kNoKey; }
  PC_HD void offer(uint64_t) { ++counted; }
};

// Decide the rows that are listed, in the tree of boxes.
PC_BLOCK_KERNEL(pc_count_in_tree, PC_SEARCH_PARAMETERS, int64_t enough, uint8_t* outlier) {
  PC_SEARCH;
  KeyCount found{0, enough};
  Query query = asked.query();
  query.most = key_of(static_cast<float>(limit), 0);  // no key of a distance that is not less
  if (query.most == 0) query.begin = query.end = 0;
  --query.most;
  search(tree, query, found);
  if (asked.is_one()) outlier[asked.row()] = found.counted <= enough;
}

}  // namespace pc::gpu
