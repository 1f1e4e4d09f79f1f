// The rows of images with those around them, as if there were pixels without a reading beyond the images.
#pragma once

#include "pc/simd.hpp"
#include "pc/threads.hpp"

namespace pc::images {

struct Shape {
  int64_t views, height, width;
};

// Of which depths there is a reading: those that are positive, within [near, far] and inside the mask, which may be
// null.
struct DepthRange {
  float near, far;
  const uint8_t* mask;

  void copy(const float* __restrict from, int64_t at, int64_t count, float* __restrict to) const {
    from += at;
    for (int64_t i = 0; i < count; ++i) to[i] = (from[i] > 0) & (from[i] >= near) & (from[i] <= far) ? from[i] : 0.0f;
    if (mask == nullptr) return;
    const uint8_t* __restrict inside = mask + at;
    for (int64_t i = 0; i < count; ++i) to[i] = inside[i] != 0 ? to[i] : 0.0f;
  }
};

// 2 reach + 1 rows side by side, each with `reach` pixels without a reading at both ends, and room for a register
// behind; above and below an image all are without.
class PaddedRows {
 public:
  PaddedRows(const float* values, const Shape& shape, int64_t reach, const DepthRange* range)
      : values_(values),
        range_(range),
        shape_(shape),
        reach_(reach),
        stride_(shape.width + 2 * reach + kLanes),
        padded_(static_cast<size_t>((2 * reach + 1) * stride_), 0.0f) {}

  // Rows row - reach .. row + reach, each from `reach` pixels left of the image on; row counts over all views. Rows
  // that the call before brought are there already, if it asked for the row above this one.
  void around(int64_t row, bool follows, const float** rows) {
    const int64_t count = 2 * reach_ + 1;
    for (int64_t r = 0; r < count; ++r) {
      float* to = padded_.data() + (row + r) % count * stride_;
      rows[r] = to;
      if (r + 1 < count && follows && row % shape_.height != 0) continue;
      const int64_t v = row % shape_.height + r - reach_;
      if (v < 0 || v >= shape_.height)
        std::fill_n(to + reach_, shape_.width, 0.0f);
      else if (range_ != nullptr)
        range_->copy(values_, (row + r - reach_) * shape_.width, shape_.width, to + reach_);
      else
        std::copy_n(values_ + (row + r - reach_) * shape_.width, shape_.width, to + reach_);
    }
  }

 private:
  const float* values_;
  const DepthRange* range_;  // or null: all values as they are
  Shape shape_;
  int64_t reach_, stride_;
  std::vector<float> padded_;
};

// Call body(row, rows around it) for all rows of all images; rows[reach][u + reach] is pixel u. With a range, values
// that are no readings are 0.
template <class Body>
void for_rows(const pc_context& context, const float* values, const Shape& shape, int64_t reach, Body&& body,
              const DepthRange* range = nullptr) {
  constexpr int64_t kPixels = 1 << 15, kMostRows = 15;
  const int64_t rows_at_once = std::max<int64_t>(1, kPixels / std::max<int64_t>(shape.width, 1));
  parallel_for(context, shape.views * shape.height, rows_at_once, [&](int64_t begin, int64_t end, int64_t) {
    PaddedRows padded(values, shape, reach, range);
    for (int64_t row = begin; row < end; ++row) {
      const float* rows[kMostRows];
      padded.around(row, row > begin, rows);
      body(row, rows);
    }
  });
}

}  // namespace pc::images
