// Smooth regions of depth images, and planes of their points at contacts: what parts objects that touch.
//
// All sums are taken in the order of the reference: regions and planes are equal, normals but for the last digit.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "pc/cells/union_find.hpp"
#include "pc/memory.hpp"
#include "pc/threads.hpp"

namespace pc::touching {
namespace {

// As pcdata.functional.touching.limits lays them out.
struct Limits {
  double normal_reach, crease_reach, contact_reach, jump, gate, step, slope, full_crease, convex_part, smooth;
  double angle_from, angle_full, gap_from, gap_full, seed_area, rim, roughest, rough_area, part_area;
};
struct Camera {
  double fx, fy, cx, cy;
};

constexpr int kLevels = 24;
constexpr double kSmooth[3] = {1, 1.5, 2};  // times the limit
constexpr double kNormalPixels[2] = {3, 14}, kSteepPixels[2] = {3, 4};
constexpr double kCreasePixels[2] = {2, 12}, kContactPixels[2] = {5, 16};
constexpr int64_t kRows = 8;  // image rows that a thread takes at once

double in_pixels(double length, const Camera& camera, double inverse, const double* bounds) {
  return std::clamp(std::floor(length * camera.fx * inverse + 0.5), bounds[0], bounds[1]);
}

struct Image {
  const double* inverse;
  int64_t height, width;
  Camera camera;
  double noise, scale;
  const Limits* limits;

  int64_t size() const { return height * width; }
  bool there(int64_t pixel) const { return inverse[pixel] > 0; }
  double x(int64_t column) const { return (static_cast<double>(column) - camera.cx) / camera.fx; }
  double y(int64_t row) const { return (static_cast<double>(row) - camera.cy) / camera.fy; }
};

// -- planes of 1/z over pixels ------------------------------------------------------------------------------------

enum Sum { kN, kU, kV, kUU, kUV, kVV, kD, kUD, kVD, kSums };

struct Plane {
  double right, down, middle, mean_u, mean_v;
  bool found;
};

Plane solve(double n, double u, double v, double uu, double uv, double vv, double d, double ud, double vd) {
  const double count = n < 1 ? 1 : n;
  const double mean_u = u / count, mean_v = v / count, mean_d = d / count;
  uu = uu - u * mean_u, uv = uv - u * mean_v, vv = vv - v * mean_v;
  ud = ud - u * mean_d, vd = vd - v * mean_d;
  const double determinant = uu * vv - uv * uv;
  const bool found = n >= 5 && determinant > 1e-3 * (uu * vv) && determinant > 1e-6;
  const double right = found ? (ud * vv - vd * uv) / determinant : 0;
  const double down = found ? (vd * uu - ud * uv) / determinant : 0;
  return {right, down, (mean_d - right * mean_u) - down * mean_v, mean_u, mean_v, found};
}

// The vector across a plane that is `middle` on the ray (x, y, 1), away from the camera, and its length.
struct Across {
  double x, y, z, length;
};
Across across_plane(const Plane& plane, double middle, double x, double y, const Camera& camera) {
  const double ax = plane.right * camera.fx, ay = plane.down * camera.fy;
  const double az = (middle - ax * x) - ay * y;
  return {ax, ay, az, std::sqrt((ax * ax + ay * ay) + az * az)};
}

// -- planes around every pixel ------------------------------------------------------------------------------------

struct Offset {
  int64_t down, right;
  double reach, steepness;
};

// Add one offset to the sums of a row, column by column: a loop without branches becomes vector code.
void add_offset(const double* own, const double* other, const double* reach, int64_t count, const Offset& offset,
                double gate, double* const* sums) {
  const auto right = static_cast<double>(offset.right), down = static_cast<double>(offset.down);
  const double uu = right * right, uv = right * down, vv = down * down;
  double *n = sums[kN], *u = sums[kU], *v = sums[kV], *suu = sums[kUU], *suv = sums[kUV], *svv = sums[kVV];
  double *d = sums[kD], *ud = sums[kUD], *vd = sums[kVD];
#pragma GCC ivdep
  for (int64_t i = 0; i < count; ++i) {
    const double rise = other[i] - own[i];
    const double allowed = gate + offset.steepness * own[i];
    const bool used = (own[i] > 0) & (other[i] > 0) & (reach[i] >= offset.reach) & (std::fabs(rise) < allowed);
    const double weight = used ? 1.0 : 0.0;
    n[i] += weight;
    u[i] += weight * right;
    v[i] += weight * down;
    suu[i] += weight * uu;
    suv[i] += weight * uv;
    svv[i] += weight * vv;
    const double weighted = weight * rise;
    d[i] += weighted;
    ud[i] += weighted * right;
    vd[i] += weighted * down;
  }
}

// Fit a plane around every pixel and pass it on: body(pixel, x, y, plane, its 1/z at the pixel).
template <class Body>
void window_planes(const pc_context& context, const Image& image, const double* bounds, Body&& body) {
  const Limits& limits = *image.limits;
  const int64_t width = image.width;
  const double gate = limits.gate * image.noise, steepness = limits.slope / image.camera.fx;
  parallel_for(context, image.height, kRows, [&](int64_t begin, int64_t end, int64_t) {
    std::vector<double> buffer(static_cast<size_t>(width * (kSums + 1)));
    double* reach = buffer.data() + width * kSums;
    double* sums[kSums];
    for (int64_t row = begin; row < end; ++row) {
      const double* own = image.inverse + row * width;
      int64_t first = 0, last = width;
      while (first < last && !(own[first] > 0)) ++first;
      while (last > first && !(own[last - 1] > 0)) --last;
      if (first == last) continue;
      double most = 0;
      for (int64_t c = first; c < last; ++c) {
        reach[c] = in_pixels(limits.normal_reach * image.scale, image.camera, own[c], bounds);
        if (own[c] > 0) most = std::max(most, reach[c]);
      }
      std::fill_n(buffer.data(), width * kSums, 0.0);
      const int64_t farthest = static_cast<int64_t>(most) / 2 * 2;
      for (int64_t down = -farthest; down <= farthest; down += 2) {
        const int64_t at = row + down;
        if (at < 0 || at >= image.height) continue;
        for (int64_t right = -farthest; right <= farthest; right += 2) {
          const int64_t from = std::max(first, -right), to = std::min(last, width - right);
          if (from >= to) continue;
          const double away = std::sqrt(static_cast<double>(right * right + down * down));
          const Offset offset{down, right, static_cast<double>(std::max(std::abs(down), std::abs(right))),
                              steepness * away};
          for (int s = 0; s < kSums; ++s) sums[s] = buffer.data() + s * width + from;
          add_offset(own + from, image.inverse + at * width + from + right, reach + from, to - from, offset, gate,
                     sums);
        }
      }
      for (int64_t c = first; c < last; ++c) {
        if (!(own[c] > 0)) continue;
        const double* b = buffer.data() + c;
        const Plane plane = solve(b[0], b[width], b[2 * width], b[3 * width], b[4 * width], b[5 * width], b[6 * width],
                                  b[7 * width], b[8 * width]);
        if (plane.found) body(row * width + c, image.x(c), image.y(row), plane, own[c] + plane.middle);
      }
    }
  });
}

void window_normals(const pc_context& context, const Image& image, double* normals) {
  std::fill_n(normals, 3 * image.size(), 0.0);
  window_planes(context, image, kNormalPixels,
                [&](int64_t pixel, double x, double y, const Plane& plane, double middle) {
                  const Across across = across_plane(plane, middle, x, y, image.camera);
                  const double safe = across.length > 0 ? across.length : 1;
                  double* normal = normals + 3 * pixel;
                  normal[0] = -across.x / safe, normal[1] = -across.y / safe, normal[2] = -across.z / safe;
                });
}

// Mark where planes lean more from facing the camera than any surface that is followed.
void mark_steep(const pc_context& context, const Image& image, uint8_t* steep) {
  std::fill_n(steep, image.size(), 0);
  const double slope = image.limits->slope, least = 1 / std::sqrt(1 + slope * slope);
  window_planes(context, image, kSteepPixels,
                [&](int64_t pixel, double x, double y, const Plane& plane, double middle) {
                  const double length = across_plane(plane, middle, x, y, image.camera).length;
                  const double ray = std::sqrt((x * x + y * y) + 1);
                  steep[pixel] = middle < (least * length) * ray;
                });
}

// -- creases ------------------------------------------------------------------------------------------------------

double dot(const double* a, const double* b) { return (a[0] * b[0] + a[1] * b[1]) + a[2] * b[2]; }

void creases(const pc_context& context, const Image& image, const double* normals, double* sharpest) {
  const Limits& limits = *image.limits;
  const int64_t width = image.width, height = image.height;
  const double half = std::sqrt(0.5), most = limits.step * image.noise;
  const int64_t ways[4][2] = {{1, 0}, {0, 1}, {1, 1}, {1, -1}};  // right, down
  parallel_for(context, height, kRows, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t row = begin; row < end; ++row) {
      for (int64_t column = 0; column < width; ++column) {
        const int64_t pixel = row * width + column;
        sharpest[pixel] = 0;
        if (!image.there(pixel)) continue;
        const double reach =
            in_pixels(limits.crease_reach * image.scale, image.camera, image.inverse[pixel], kCreasePixels);
        double found = 0;
        for (const auto& way : ways) {
          const auto count =
              static_cast<int64_t>(way[0] * way[1] == 0 ? reach : std::max(std::floor(reach * half + 0.5), 1.0));
          const int64_t up = row - count * way[1], low = row + count * way[1];
          const int64_t left = column - count * way[0], right = column + count * way[0];
          if (std::min(up, low) < 0 || std::max(up, low) >= height || left < 0 || right >= width) continue;
          const int64_t a = up * width + left, b = low * width + right;
          const double *na = normals + 3 * a, *nb = normals + 3 * b;
          if (!(na[0] != 0 || na[1] != 0 || na[2] != 0) || !(nb[0] != 0 || nb[1] != 0 || nb[2] != 0)) continue;
          const double turn[3] = {nb[0] - na[0], nb[1] - na[1], nb[2] - na[2]};
          const double apart = std::sqrt(dot(turn, turn));
          if (!(apart > found)) continue;  // nor would its part be
          const int64_t stride = way[1] * width + way[0];
          double last = image.inverse[a];
          bool usable = true;
          for (int64_t k = 1; k <= 2 * count && usable; ++k) {
            const double now = image.inverse[a + k * stride];
            usable = now > 0 && std::fabs(now - last) < most;
            last = now;
          }
          if (!usable) continue;
          const double za = 1 / image.inverse[a], zb = 1 / image.inverse[b];
          const double across[3] = {image.x(right) * zb - image.x(left) * za, image.y(low) * zb - image.y(up) * za,
                                    zb - za};
          found = std::max(found, dot(turn, across) < 0 ? apart : limits.convex_part * apart);
        }
        sharpest[pixel] = found;
      }
    }
  });
}

constexpr double kGaussian[5] = {0.054488, 0.244202, 0.402619, 0.244202, 0.054488};

// Sum over five pixels along a column or a row; beyond the image there is nothing.
template <class Value>
double convolved(const Value& value, int64_t at, int64_t stride, int64_t place, int64_t length) {
  double sum = 0;
  for (int64_t k = -2; k <= 2; ++k)
    sum += kGaussian[k + 2] * (place + k >= 0 && place + k < length ? value(at + k * stride) : 0.0);
  return sum;
}

// Divide by a full crease, smooth over the pixels that are there, and count in levels.
void levels(const pc_context& context, const Image& image, const double* sharpest, double* scratch, double* crease) {
  const int64_t width = image.width, size = image.size();
  double *total = scratch, *weight = scratch + size;
  parallel_for(context, image.height, kRows, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t row = begin; row < end; ++row)
      for (int64_t c = 0; c < width; ++c) {
        const int64_t p = row * width + c;
        const auto part = [&](int64_t q) {
          return image.there(q) ? std::min(sharpest[q] / image.limits->full_crease, 1.0) : 0.0;
        };
        total[p] = convolved(part, p, width, row, image.height);
        weight[p] = convolved([&](int64_t q) { return image.there(q) ? 1.0 : 0.0; }, p, width, row, image.height);
      }
  });
  parallel_for(context, image.height, kRows, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t p = begin * width; p < end * width; ++p) {
      if (!image.there(p)) {
        crease[p] = 1;
        continue;
      }
      const int64_t c = p % width;
      const double sum = convolved([&](int64_t q) { return total[q]; }, p, 1, c, width);
      crease[p] = sum / convolved([&](int64_t q) { return weight[q]; }, p, 1, c, width);
    }
  });
}

// -- jumps, seeds and the flood -----------------------------------------------------------------------------------

// closed[p] = 1 where a jump lies between pixel p and the one `stride` behind it, of `length` in a line.
void jumps(const Image& image, int64_t stride, double limit, uint8_t* closed) {
  const int64_t width = image.width, length = stride == 1 ? width : image.height;
  for (int64_t p = 0; p < image.size(); ++p) {
    const int64_t place = stride == 1 ? p % width : p / width;
    closed[p] = 0;
    if (place + 1 >= length) continue;
    const int64_t q = p + stride;
    if (!image.there(p) || !image.there(q)) continue;
    const double step = image.inverse[q] - image.inverse[p];
    if (!(std::fabs(step) > limit)) continue;
    bool jump = true;
    if (place > 0 && image.there(p - stride))
      jump &= std::fabs(step - (image.inverse[p] - image.inverse[p - stride])) > limit;
    if (place + 2 < length && image.there(q + stride))
      jump &= std::fabs((image.inverse[q + stride] - image.inverse[q]) - step) > limit;
    closed[p] = jump;
  }
}

class Flood {
 public:
  // Without creases (null) all is one level.
  Flood(const Image& image, const double* crease, const uint8_t* across, const uint8_t* along, int64_t* label)
      : image_(image), across_(across), along_(along), label_(label), level_(static_cast<size_t>(image.size())) {
    if (crease == nullptr) return;
    for (int64_t p = 0; p < image.size(); ++p)
      level_[static_cast<size_t>(p)] = static_cast<uint8_t>(std::floor(crease[p] * kLevels));
  }

  // Number the parts that are smooth together with all pixels around them, and large enough: first the smoothest, then
  // what is as smooth as the next limit and holds none of them.
  void seeds(const double* crease, uint8_t* smooth, std::atomic<uint32_t>* parents, double* area) {
    const int64_t width = image_.width, height = image_.height, size = image_.size();
    const double pixels = image_.camera.fx * image_.camera.fy;
    std::vector<uint8_t> inside(static_cast<size_t>(size));
    std::vector<int64_t> of(static_cast<size_t>(size));
    int64_t number = 0;
    std::fill_n(label_, size, -1);
    for (const double factor : kSmooth) {
      if (factor > image_.limits->roughest) break;
      const double limit = image_.limits->smooth * factor;
      const double least = factor == 1 ? image_.limits->seed_area : image_.limits->rough_area;
      for (int64_t p = 0; p < size; ++p) {
        const int64_t row = p / width, c = p % width;
        smooth[p] = image_.there(p) && crease[p] < limit && !across_[p] && !along_[p] && !(c > 0 && across_[p - 1]) &&
                    !(row > 0 && along_[p - width]);
      }
      cells::UnionFind parts(parents, size);
      std::fill(inside.begin(), inside.end(), 0);
      for (int64_t row = 1; row + 1 < height; ++row)
        for (int64_t c = 1; c + 1 < width; ++c) {
          const int64_t p = row * width + c;
          bool all = smooth[p];
          for (int64_t down = -1; down <= 1 && all; ++down)
            for (int64_t right = -1; right <= 1; ++right) all &= smooth[p + down * width + right] != 0;
          inside[static_cast<size_t>(p)] = all;
          if (!all) continue;
          if (inside[static_cast<size_t>(p - 1)]) parts.join(static_cast<uint32_t>(p), static_cast<uint32_t>(p - 1));
          if (inside[static_cast<size_t>(p - width)])
            parts.join(static_cast<uint32_t>(p), static_cast<uint32_t>(p - width));
        }
      std::fill_n(area, size, 0.0);
      std::fill(of.begin(), of.end(), -1);  // -2 = holds a smoother part
      for (int64_t p = 0; p < size; ++p) {
        if (!inside[static_cast<size_t>(p)]) continue;
        const double inverse = image_.inverse[p];
        const int64_t root = parts.find(static_cast<uint32_t>(p));
        area[root] += 1 / std::max(inverse * inverse, 1e-12) / pixels;
        if (label_[p] >= 0) of[static_cast<size_t>(root)] = -2;
      }
      for (int64_t p = 0; p < size; ++p) {
        if (!inside[static_cast<size_t>(p)]) continue;
        const int64_t root = parts.find(static_cast<uint32_t>(p));
        int64_t& own = of[static_cast<size_t>(root)];
        if (own == -2 || !(area[root] >= least)) continue;
        if (own < 0) own = number++;
        label_[p] = own;
      }
    }
  }

  // Let the labels take what they reach over open borders, or over all, level by level. In each round all pixels that
  // are reached take the lowest label beside them, as it was before the round.
  void run(Poll& poll, bool over_all) {
    over_all_ = over_all;
    for (auto& waiting : waiting_) waiting.clear();
    queued_.assign(static_cast<size_t>(image_.size()), 0);
    for (int64_t p = 0; p < image_.size(); ++p)
      if (label_[p] >= 0) offer_beside(p);
    for (int now = 0; now <= kLevels; ++now) {
      poll.check();
      auto& round = waiting_[now];
      while (!round.empty()) {
        taken_.resize(round.size());
        for (size_t i = 0; i < round.size(); ++i) taken_[i] = lowest_beside(round[i]);
        reached_.swap(round);
        round.clear();
        for (size_t i = 0; i < reached_.size(); ++i) label_[reached_[i]] = taken_[i];
        for (const int64_t p : reached_) offer_beside(p, now);
      }
    }
  }

 private:
  template <class Body>
  void beside(int64_t p, Body&& body) const {
    const int64_t width = image_.width, row = p / width, c = p % width;
    if (c > 0 && (over_all_ || !across_[p - 1])) body(p - 1);
    if (c + 1 < width && (over_all_ || !across_[p])) body(p + 1);
    if (row > 0 && (over_all_ || !along_[p - width])) body(p - width);
    if (row + 1 < image_.height && (over_all_ || !along_[p])) body(p + width);
  }
  void offer_beside(int64_t p, int now = 0) {
    beside(p, [&](int64_t q) {
      if (!image_.there(q) || label_[q] >= 0 || queued_[static_cast<size_t>(q)]) return;
      queued_[static_cast<size_t>(q)] = 1;
      waiting_[std::max<int>(level_[static_cast<size_t>(q)], now)].push_back(q);
    });
  }
  int64_t lowest_beside(int64_t p) const {
    int64_t lowest = INT64_MAX;
    beside(p, [&](int64_t q) {
      if (label_[q] >= 0) lowest = std::min(lowest, label_[q]);
    });
    return lowest;
  }

  const Image& image_;
  const uint8_t *across_, *along_;
  int64_t* label_;
  std::vector<uint8_t> level_, queued_;
  std::vector<int64_t> waiting_[kLevels + 1], reached_, taken_;
  bool over_all_ = false;
};

// Cut regions in which jumps, and lines that are steep, part two and more large parts; the parts take what else there
// is of their region. Regions are numbered by their first pixels. The jumps become the borders of regions.
void cut_regions(const Image& image, const uint8_t* steep, int64_t* label, std::atomic<uint32_t>* parents, double* area,
                 uint8_t* across, uint8_t* along, Poll& poll) {
  const int64_t width = image.width, size = image.size();
  const double pixels = image.camera.fx * image.camera.fy;
  cells::UnionFind parts(parents, size);
  const auto flat = [&](int64_t p) { return label[p] >= 0 && !steep[p]; };
  const auto connect = [&](int64_t p, int64_t q, uint8_t& closed) {
    if (label[p] == label[q] && !closed && flat(p) && flat(q))
      parts.join(static_cast<uint32_t>(p), static_cast<uint32_t>(q));
    closed = label[p] != label[q];
  };
  int64_t count = 0;
  for (int64_t p = 0; p < size; ++p) {
    if (p % width + 1 < width) connect(p, p + 1, across[p]);
    if (p + width < size) connect(p, p + width, along[p]);
    count = std::max(count, label[p] + 1);
  }
  std::fill_n(area, size, 0.0);
  for (int64_t p = 0; p < size; ++p)
    if (flat(p))
      area[parts.find(static_cast<uint32_t>(p))] += 1 / std::max(image.inverse[p] * image.inverse[p], 1e-12) / pixels;
  const auto is_large = [&](int64_t root) { return area[root] >= image.limits->part_area; };
  std::vector<int64_t> large(static_cast<size_t>(count), 0), whole(static_cast<size_t>(count), -1);
  for (int64_t p = 0; p < size; ++p)
    if (flat(p) && parts.find(static_cast<uint32_t>(p)) == p && is_large(p)) ++large[static_cast<size_t>(label[p])];
  std::vector<int64_t> number(static_cast<size_t>(size), -1);  // of parts, by their roots: their first pixels
  int64_t next = 0;
  for (int64_t p = 0; p < size; ++p) {
    if (label[p] < 0) continue;
    const auto own = static_cast<size_t>(label[p]);
    if (large[own] < 2) {
      if (whole[own] < 0) whole[own] = next++;
      label[p] = whole[own];
    } else {
      const int64_t root = flat(p) ? int64_t{parts.find(static_cast<uint32_t>(p))} : -1;
      if (root == p && is_large(p)) number[static_cast<size_t>(p)] = next++;
      label[p] = root >= 0 ? number[static_cast<size_t>(root)] : -1;
    }
  }
  Flood(image, nullptr, across, along, label).run(poll, false);
}

}  // namespace
}  // namespace pc::touching

PC_EXPORT int32_t pc_smooth_regions(const pc_context* context, const double* inverse, int64_t height, int64_t width,
                                    const double* camera, double noise, double scale, const double* limits,
                                    int64_t* label, double* normals) {
  using namespace pc;
  using namespace pc::touching;
  return guarded([&] {
    ScratchFrame scratch;
    const Image image{inverse,
                      height,
                      width,
                      *reinterpret_cast<const Camera*>(camera),
                      noise,
                      scale,
                      reinterpret_cast<const Limits*>(limits)};
    const int64_t size = image.size();
    double *sharpest = scratch.take<double>(size), *crease = scratch.take<double>(size);
    double* sums = scratch.take<double>(2 * size);
    uint8_t *across = scratch.take<uint8_t>(size), *along = scratch.take<uint8_t>(size);
    uint8_t* marks = scratch.take<uint8_t>(size);
    auto* parents = scratch.take<std::atomic<uint32_t>>(size);
    Poll poll(*context);
    window_normals(*context, image, normals);
    creases(*context, image, normals, sharpest);
    levels(*context, image, sharpest, sums, crease);
    poll.check();
    jumps(image, 1, image.limits->jump * noise, across);
    jumps(image, width, image.limits->jump * noise, along);
    Flood flood(image, crease, across, along, label);
    flood.seeds(crease, marks, parents, sums);
    for (const bool over_jumps : {false, true}) flood.run(poll, over_jumps);
    mark_steep(*context, image, marks);
    cut_regions(image, marks, label, parents, sums, across, along, poll);
  });
}

PC_EXPORT int32_t pc_region_planes(const pc_context* context, const double* inverse, const int64_t* label,
                                   int64_t height, int64_t width, const double* camera, double scale,
                                   const double* limits, const int64_t* pixel, int64_t count, double* planes) {
  using namespace pc;
  using namespace pc::touching;
  return guarded([&] {
    const Image image{inverse,
                      height,
                      width,
                      *reinterpret_cast<const Camera*>(camera),
                      0,
                      scale,
                      reinterpret_cast<const Limits*>(limits)};
    parallel_for(*context, count, 64, [&](int64_t begin, int64_t end, int64_t) {
      for (int64_t i = begin; i < end; ++i) {
        const int64_t row = pixel[i] / width, column = pixel[i] % width;
        const double own = inverse[pixel[i]];
        const auto reach =
            static_cast<int64_t>(in_pixels(image.limits->contact_reach * scale, image.camera, own, kContactPixels));
        const int64_t farthest = reach / 2 * 2;
        double n = 0, u = 0, v = 0, uu = 0, uv = 0, vv = 0, d = 0, ud = 0, vd = 0;
        for (int64_t down = -farthest; down <= farthest; down += 2) {
          const int64_t y = row + down;
          if (y < 0 || y >= height) continue;
          for (int64_t right = -farthest; right <= farthest; right += 2) {
            const int64_t x = column + right, p = y * width + x;
            if (x < 0 || x >= width || label[p] != label[pixel[i]]) continue;
            const auto du = static_cast<double>(right), dv = static_cast<double>(down);
            const double rise = inverse[p] - own;
            n += 1, u += du, v += dv, uu += du * du, uv += du * dv, vv += dv * dv;
            d += rise, ud += rise * du, vd += rise * dv;
          }
        }
        const Plane plane = solve(n, u, v, uu, uv, vv, d, ud, vd);
        double* to = planes + 6 * i;
        to[0] = plane.right, to[1] = plane.down, to[2] = plane.middle;
        to[3] = plane.mean_u, to[4] = plane.mean_v, to[5] = plane.found ? 1 : 0;
      }
    });
  });
}
