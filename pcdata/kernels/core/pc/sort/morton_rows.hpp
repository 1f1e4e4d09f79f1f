// Rows sorted along a Morton (Z-order) curve, for clouds of any density.
#pragma once

#include <mutex>
#include <utility>

#include "pc/bounds.hpp"
#include "pc/math/morton.hpp"
#include "pc/sort/radix.hpp"

namespace pc::sort {

// Sorts rows of points by the cell they lie in. A key is a 33-bit Morton code (11 bits per axis) above the 31-bit row,
// so equal cells keep the order of rows. A run of more than `kCrowd` equal codes is coded again in its own cube: one
// stray point a kilometer away does not blur the order of the rest, and only equal points stay together.
class MortonRows {
 public:
  // Fill keys[0, end-begin) with the rows [begin, end) of points (N, 3) in Morton order; `spare` is as long.
  MortonRows(const pc_context& context, const float* points) : context_(context), points_(points) {}

  static uint32_t row(uint64_t key) { return static_cast<uint32_t>(key & kRowMask); }

  void sort(int64_t begin, int64_t end, uint64_t* keys, uint64_t* spare) const {
    if (end - begin < kParallelFrom) return sort_small_cloud(begin, end, keys, spare);
    parallel_for(context_, end - begin, kPiece, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t i = first; i < last; ++i) keys[i] = static_cast<uint64_t>(begin + i);
    });
    sort_parallel(keys, spare, end - begin);
  }

  // The same on this thread alone.
  void sort_small_cloud(int64_t begin, int64_t end, uint64_t* keys, uint64_t* spare) const {
    for (int64_t i = begin; i < end; ++i) keys[i - begin] = static_cast<uint64_t>(i);
    sort_serial(keys, spare, end - begin);
  }

  // Clouds shorter than this are sorted by one thread.
  static constexpr int64_t kParallelFrom = 1 << 15;

 private:
  static constexpr int kBits = 11;  // per axis: three digits of the radix sort, whose counters fit the L1 cache
  static constexpr int kCells = 1 << kBits;
  static constexpr int kRowBits = 31;
  static constexpr uint64_t kRowMask = (uint64_t{1} << kRowBits) - 1;
  static constexpr int64_t kCrowd = 16;  // a leaf of the box tree
  static constexpr int64_t kPiece = 1 << 14;
  static constexpr int64_t kRadixFrom = 768;  // shorter runs are faster by comparison

  struct Cube {
    double low[3];
    double per_length = 0;  // 0: all points are equal

    explicit Cube(const math::Bounds& bounds) {
      for (int axis = 0; axis < 3; ++axis) low[axis] = bounds.low[axis];
      const double longest = bounds.extent();
      if (longest > 0) per_length = (kCells - 1) / longest;
    }
    uint64_t code(const float* p) const { return math::morton_code(cell(p[0], 0), cell(p[1], 1), cell(p[2], 2)); }

   private:
    uint64_t cell(float value, int axis) const {
      return static_cast<uint64_t>(static_cast<int32_t>((double(value) - low[axis]) * per_length));
    }
  };

  const float* point(uint64_t key) const { return points_ + 3 * int64_t{row(key)}; }

  math::Bounds bounds(const uint64_t* keys, int64_t count) const {
    auto all = math::Bounds::of_point(point(keys[0]));
    for (int64_t i = 1; i < count; ++i) all.include(point(keys[i]));
    return all;
  }

  void encode(const Cube& cube, uint64_t* keys, int64_t begin, int64_t end) const {
    for (int64_t i = begin; i < end; ++i) keys[i] = cube.code(point(keys[i])) << kRowBits | row(keys[i]);
  }

  // Keys hold rows in ascending order on entry.
  void sort_serial(uint64_t* keys, uint64_t* spare, int64_t count) const {
    if (count <= 1) return;
    const Cube cube(bounds(keys, count));
    if (cube.per_length == 0) return;
    encode(cube, keys, 0, count);
    if (count < kRadixFrom) {
      std::sort(keys, keys + count);
    } else {
      std::copy(keys, keys + count, spare);
      for (int digit = 0; digit < 3; ++digit) {
        sort_digit(spare, keys, count, digit);
        std::swap(keys, spare);
      }
      std::swap(keys, spare);  // three passes: the result is where it should be
    }
    for_crowded_runs(keys, 0, count, [&](Range run) { sort_serial_again(keys, spare, run); });
  }

  void sort_serial_again(uint64_t* keys, uint64_t* spare, Range run) const {
    forget_codes(keys, run.begin, run.end);
    sort_serial(keys + run.begin, spare + run.begin, run.end - run.begin);
  }

  void sort_parallel(uint64_t* keys, uint64_t* spare, int64_t count) const {
    const Cube cube(parallel_bounds(keys, count));
    if (cube.per_length == 0) return;
    const std::vector<Range> chunks = chunks_of(count);
    std::vector<uint32_t> places(chunks.size() * kCells), bucket(kCells + 1);
    bucket[kCells] = counting_pass(
        context_, chunks, kCells, places.data(), [&](Range chunk) { encode(cube, keys, chunk.begin, chunk.end); },
        [=](int64_t i) { return digit_of(keys[i], 2); }, [=](int64_t i) { return keys[i]; }, spare, bucket.data());
    std::mutex mutex;
    std::vector<Range> large;
    parallel_for(context_, kCells, 4, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t d = first; d < last; ++d) {
        const int64_t begin = bucket[size_t(d)], size = int64_t{bucket[size_t(d) + 1]} - begin;
        sort_bucket(keys + begin, spare + begin, size);
        for_crowded_runs(keys, begin, begin + size, [&](Range run) {
          if (run.end - run.begin < kParallelFrom) return sort_serial_again(keys, spare, run);
          const std::lock_guard<std::mutex> lock(mutex);
          large.push_back(run);
        });
      }
    });
    for (const Range run : large) {
      forget_codes(keys, run.begin, run.end);
      sort_parallel(keys + run.begin, spare + run.begin, run.end - run.begin);
    }
  }

  // Sort `spare`, whose top digits agree, into `keys`.
  static void sort_bucket(uint64_t* keys, uint64_t* spare, int64_t count) {
    if (count < kRadixFrom) {
      std::copy(spare, spare + count, keys);
      std::sort(keys, keys + count);
      return;
    }
    sort_digit(spare, keys, count, 0);
    sort_digit(keys, spare, count, 1);
    std::copy(spare, spare + count, keys);
  }

  static void sort_digit(const uint64_t* from, uint64_t* to, int64_t count, int digit) {
    uint32_t next[kCells] = {};
    for (int64_t i = 0; i < count; ++i) ++next[digit_of(from[i], digit)];
    uint32_t total = 0;
    for (uint32_t& n : next) total += std::exchange(n, total);
    for (int64_t i = 0; i < count; ++i) to[next[digit_of(from[i], digit)]++] = from[i];
  }

  static uint64_t digit_of(uint64_t key, int digit) { return key >> (kRowBits + digit * kBits) & (kCells - 1); }

  template <class Body>
  void for_crowded_runs(uint64_t* keys, int64_t begin, int64_t end, Body&& body) const {
    // A crowded run has equal codes at its first and its kCrowd-th next element.
    for (int64_t i = begin; i + kCrowd < end;) {
      const uint64_t code = keys[i] >> kRowBits;
      if (keys[i + kCrowd] >> kRowBits != code) {
        ++i;
        continue;
      }
      int64_t stop = i + kCrowd + 1;
      while (stop < end && keys[stop] >> kRowBits == code) ++stop;
      body(Range{i, stop});
      i = stop;
    }
  }

  static void forget_codes(uint64_t* keys, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) keys[i] &= kRowMask;
  }

  math::Bounds parallel_bounds(const uint64_t* keys, int64_t count) const {
    const std::vector<Range> chunks = chunks_of(count);
    std::vector<math::Bounds> parts(chunks.size());
    parallel_for(context_, static_cast<int64_t>(chunks.size()), 1, [&](int64_t c, int64_t, int64_t) {
      const Range chunk = chunks[size_t(c)];
      parts[size_t(c)] = bounds(keys + chunk.begin, chunk.size());
    });
    return hull(parts);
  }

  static std::vector<Range> chunks_of(int64_t count) {
    std::vector<Range> chunks;
    for (int64_t begin = 0; begin < count; begin += kChunk) chunks.push_back({begin, std::min(count, begin + kChunk)});
    return chunks;
  }

  static constexpr int64_t kChunk = 1 << 15;

  const pc_context& context_;
  const float* points_;
};

}  // namespace pc::sort
