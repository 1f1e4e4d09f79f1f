// Points put in an order in which neighbors in memory are neighbors in space.
#pragma once

#include <utility>

#include "pc/memory.hpp"
#include "pc/threads.hpp"

namespace pc::sort {

typedef float Float4 __attribute__((vector_size(16)));
typedef int32_t Int4 __attribute__((vector_size(16)));

// x, y, z and, as bits, the row a point came from: 16 bytes that are compared and moved as one register. (As four
// members they would be taken apart, and putting them together again costs more than the sort.)
struct PlacedPoint {
  Float4 lanes;

  PlacedPoint() = default;
  PlacedPoint(float x, float y, float z, uint32_t row) {
    auto bits = reinterpret_cast<Int4>(Float4{x, y, z, 0});
    bits[3] = static_cast<int32_t>(row);
    lanes = reinterpret_cast<Float4>(bits);
  }
  float x() const { return lanes[0]; }
  float y() const { return lanes[1]; }
  float z() const { return lanes[2]; }
  uint32_t row() const { return static_cast<uint32_t>(reinterpret_cast<Int4>(lanes)[3]); }
};

// Cuts the box of some points into cubic cells, numbers the cells along a Morton curve, sorts the points by cell, and
// does the same inside every cell that still holds too many: a recursive radix sort, most significant digit first. Each
// level measures its own box, so neither a stray point far out nor a dense spot spoils the order.
//
// `write(points, count, place)` receives every point once: a run of sorted points, and where in the order it starts.
class MortonPoints {
 public:
  // Room for `count` points, 34 bytes each.
  MortonPoints(ScratchFrame& scratch, int64_t count)
      : sorted_(scratch.take<PlacedPoint>(count)),
        spare_(scratch.take<PlacedPoint>(count)),
        keys_(scratch.take<uint16_t>(count)) {}

  // Sort points (count, 3) on this thread, in this object's room from `offset` on.
  template <class Write>
  void serial(const float* points, int64_t count, int64_t offset, const Write& write) {
    PlacedPoint* own = sorted_ + offset;
    for (int64_t i = 0; i < count; ++i) own[i] = at(points, i);
    arrange({own, spare_ + offset, keys_ + offset, count}, 0, write);
  }

  // The same for one large cloud, with all threads. Chunks of rows are counted and moved side by side, then the cells
  // of the first level are sorted side by side.
  template <class Write>
  void parallel(const pc_context& context, ScratchFrame& scratch, const float* points, int64_t count,
                const Write& write) {
    const int64_t share = (count + context.threads - 1) / context.threads;
    const int64_t chunk = std::min(std::max(share, kSmallChunk), kChunk);
    const int64_t chunks = (count + chunk - 1) / chunk;
    // Call body(chunk, its points, its keys, their number) for all chunks.
    auto for_chunks = [&](auto&& body) {
      parallel_for(context, chunks, 1, [&](int64_t c, int64_t, int64_t) {
        const int64_t begin = c * chunk;
        body(c, [=](int64_t i) { return at(points, begin + i); }, keys_ + begin, std::min(count - begin, chunk));
      });
    };
    Box* boxes = scratch.take<Box>(chunks);
    for_chunks([&](int64_t c, auto get, uint16_t*, int64_t size) { boxes[c] = Box::of(get, size); });
    for (int64_t c = 1; c < chunks; ++c) boxes[0].include(boxes[c]);
    if (count <= kEnough || boxes[0].is_point()) return serial(points, count, 0, write);

    const Cells cells(boxes[0], kMaxBits);
    Places* places = scratch.take<Places>(chunks * kMaxCells);  // (chunk, cell)
    for_chunks([&](int64_t c, auto get, uint16_t* keys, int64_t size) {
      Places* own = places + c * kMaxCells;
      std::fill_n(own, kMaxCells, Places{});
      count_cells(get, size, cells, keys, own);
    });
    std::vector<uint32_t> starts(kMaxCells + 1);
    uint32_t total = 0, largest = 0;
    for (size_t cell = 0; cell < kMaxCells; ++cell) {
      starts[cell] = total;
      for (int64_t c = 0; c < chunks; ++c) total = places[c * kMaxCells + cell].start_at(total);
      largest = std::max(largest, total - starts[cell]);
    }
    starts[kMaxCells] = total;
    for_chunks([&](int64_t c, auto get, const uint16_t* keys, int64_t size) {
      move_to_cells(get, keys, size, sorted_, places + c * kMaxCells);
    });
    // Where the largest cells allow it, every thread works in one place, which stays in its cache.
    const bool in_place = int64_t{largest} * context.threads <= count;
    parallel_for(context, kMaxCells, kCellsPerPiece, [&](int64_t first, int64_t last, int64_t thread) {
      for (int64_t cell = first; cell < last; ++cell) {
        const int64_t begin = starts[cell], room = in_place ? thread * largest : begin;
        arrange({sorted_ + begin, spare_ + room, keys_ + room, starts[cell + 1] - begin}, begin, write);
      }
    });
  }

 private:
  static constexpr int kMaxBits = 4;  // per axis and level: 4096 cells, whose counters fit the L1 cache
  static constexpr size_t kMaxCells = size_t{1} << (3 * kMaxBits);
  static constexpr int64_t kEnough = 64;         // a cell of so many points is not cut further
  static constexpr int64_t kWantedPerCell = 16;  // on a surface, which crosses about 4^bits of the 8^bits cells
  static constexpr int64_t kChunk = 1 << 16;     // points per piece of parallel work, at most
  static constexpr int64_t kSmallChunk = 1 << 13;
  static constexpr int64_t kCellsPerPiece = 32;

  struct Box {
    Float4 low, high;

    template <class Get>
    static Box of(const Get& get, int64_t count) {
      // Two of each, so that one minimum need not wait for the one before it.
      const Float4 first = get(0).lanes;
      Box even{first, first}, odd{first, first};
      for (int64_t i = 0; i + 1 < count; i += 2) {
        even.include(get(i).lanes);
        odd.include(get(i + 1).lanes);
      }
      even.include(get(count - 1).lanes);
      even.include(odd);
      return even;
    }
    void include(Float4 p) {
      low = p < low ? p : low;
      high = p > high ? p : high;
    }
    void include(const Box& other) {
      include(other.low);
      include(other.high);
    }
    // Half the longest side: the whole may overflow.
    float half_length() const {
      auto half = [this](int axis) { return high[axis] * 0.5f - low[axis] * 0.5f; };
      return std::max(half(0), std::max(half(1), half(2)));
    }
    // So small that its reciprocal might overflow.
    bool is_point() const { return half_length() < 1e-30f; }
  };

  // 2^bits cells along the longest side of a box.
  struct Cells {
    Float4 half_low, per_half;
    int32_t last;

    Cells(const Box& box, int bits)
        : half_low(Float4{box.low[0], box.low[1], box.low[2], 0} * 0.5f), last((1 << bits) - 1) {
      const float scale = static_cast<float>(1 << bits) / box.half_length();
      per_half = Float4{scale, scale, scale, 0};
    }
    uint16_t key(const PlacedPoint& p) const {
      // The row's bits as a float mean nothing and may be anything: not computed with.
      const Float4 inside = reinterpret_cast<Float4>(reinterpret_cast<Int4>(p.lanes) & Int4{-1, -1, -1, 0});
      Int4 cell = __builtin_convertvector((inside * 0.5f - half_low) * per_half, Int4);
      cell = cell < last ? cell : Int4{last, last, last, last};
      // Bits abcd of every axis to a00b00c00d, then the three interleaved.
      cell = (cell | cell << 4) & 0xC3;
      cell = (cell | cell << 2) & 0x249;
      return static_cast<uint16_t>(cell[0] | cell[1] << 1 | cell[2] << 2);
    }
  };

  // Points to put in order, and room for as many more and for their keys.
  struct Stretch {
    PlacedPoint* points;
    PlacedPoint* spare;
    uint16_t* keys;
    int64_t count;
  };

  static PlacedPoint at(const float* points, int64_t i) {
    return {points[3 * i], points[3 * i + 1], points[3 * i + 2], static_cast<uint32_t>(i)};
  }

  static int bits_for(int64_t count) {
    int bits = 1;
    while (bits < kMaxBits && (kWantedPerCell << (2 * bits)) < count) ++bits;
    return bits;
  }

  // For one cell, first how many points of a stretch fall into it, then where the next goes; apart for the two halves
  // of the stretch, worked on in turn: neighbors mostly share a cell, and one count would wait for the other.
  struct Places {
    uint32_t in_first, in_second;

    // Turn counts into places from `start` on; return where the next cell starts.
    uint32_t start_at(uint32_t start) {
      start += std::exchange(in_first, start);
      return start + std::exchange(in_second, start);
    }
  };

  template <class Get>
  static void count_cells(const Get& get, int64_t count, const Cells& cells, uint16_t* keys, Places* places) {
    const int64_t half = count / 2;
    for (int64_t i = 0; i < half; ++i) {
      ++places[keys[i] = cells.key(get(i))].in_first;
      ++places[keys[half + i] = cells.key(get(half + i))].in_second;
    }
    if (2 * half < count) ++places[keys[count - 1] = cells.key(get(count - 1))].in_second;
  }

  template <class Get>
  static void move_to_cells(const Get& get, const uint16_t* keys, int64_t count, PlacedPoint* to, Places* places) {
    const int64_t half = count / 2;
    for (int64_t i = 0; i < half; ++i) {
      to[places[keys[i]].in_first++] = get(i);
      to[places[keys[half + i]].in_second++] = get(half + i);
    }
    if (2 * half < count) to[places[keys[count - 1]].in_second++] = get(count - 1);
  }

  // Every level cuts the longest side by 4 or more, so floats end the recursion after 138 levels at the latest; a cell
  // that holds all points ends it too.
  template <class Write>
  static void arrange(const Stretch& all, int64_t place, const Write& write) {
    if (all.count <= kEnough) return write(all.points, all.count, place);
    auto get = [from = all.points](int64_t i) { return from[i]; };
    const Box box = Box::of(get, all.count);
    if (box.is_point()) return write(all.points, all.count, place);
    const int bits = bits_for(all.count);
    const Cells cells(box, bits);
    std::vector<Places> places(size_t{1} << (3 * bits), Places{});
    count_cells(get, all.count, cells, all.keys, places.data());
    uint32_t total = 0;
    for (Places& cell : places) total = cell.start_at(total);
    move_to_cells(get, all.keys, all.count, all.spare, places.data());

    // Cells that are done go out together with those before them.
    int64_t written = 0, begin = 0;
    for (const Places& cell : places) {
      const int64_t end = cell.in_second;
      if (end - begin > kEnough && end - begin < all.count) {
        write(all.spare + written, begin - written, place + written);
        arrange({all.spare + begin, all.points + begin, all.keys + begin, end - begin}, place + begin, write);
        written = end;
      }
      begin = end;
    }
    write(all.spare + written, all.count - written, place + written);
  }

  PlacedPoint* sorted_;
  PlacedPoint* spare_;
  uint16_t* keys_;
};

}  // namespace pc::sort
