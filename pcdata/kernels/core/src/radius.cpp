// Radius outliers: points with too few neighbours, found without counting more of them than it takes to decide.
//
// 1. Points that follow one another in memory are near one another when they come from a depth image, so nearly all
//    find enough neighbours among the next few before and after them, and nearly all others, where the image is known,
//    in the rows above and below. Any hit is a real neighbour: no proof needed, and a wrong image would do no harm.
// 2. What is left (depth edges, strays) needs only the points around it, picked by a bitmap of coarse blocks of space.
// 3. Those are sorted into cells; a cell with enough points decides itself, other points count the cells around them.
//
// Points in no order skip to the third step.
#include "pc/cells/cells.hpp"

namespace {

using namespace pc;

struct Search {
  const float* points;  // (count, 3) one cloud
  int64_t count;
  float radius, limit;  // a neighbour has d2 < limit
  int64_t enough;       // neighbours that make an inlier, itself included
  uint8_t* outlier;     // (count,) 1 = not yet shown to be an inlier
  const int64_t* pixel; // (count,) where each point lies in an image, rising; null = unknown
  int64_t width;        // of the image
};

// Coordinates of the points around a piece of a cloud, infinitely far away (so never near) outside the cloud.
constexpr int kPiece = 1024;
constexpr int kMostAround = 128;
struct Window {
  static constexpr int kSize = kPiece + 2 * kMostAround;
  alignas(64) float x[kSize], y[kSize], z[kSize];

  void load(const float* points, int64_t count, int64_t first) {  // slot 0 is point `first`, which may be negative
    const int begin = static_cast<int>(std::clamp<int64_t>(-first, 0, kSize));
    const int end = static_cast<int>(std::clamp<int64_t>(count - first, 0, kSize));
    const auto clear = [&](int from, int to) {
      for (float* axis : {x, y, z}) std::fill(axis + from, axis + to, std::numeric_limits<float>::infinity());
    };
    clear(0, begin);
    clear(end, kSize);
    for (int i = begin; i < end; ++i) {
      const float* point = points + 3 * (first + i);
      x[i] = point[0];
      y[i] = point[1];
      z[i] = point[2];
    }
  }
  bool near(int a, int b, float limit) const {
    return squared_distance(x[a], y[a], z[a], x[b], y[b], z[b]) < limit;
  }
};

// Finds the pixel so many rows away from one point after another. It looks first as many points away as it was for the
// last one: rows of an image lose about equally many pixels.
class PixelSearch {
 public:
  explicit PixelSearch(const Search& search) : search_(search) {}

  // The first point at or after a pixel, which is some rows away from point i.
  int64_t seek(int64_t pixel, int64_t i) {
    const int64_t* begin = search_.pixel;
    const int64_t* end = begin + search_.count;
    const int64_t* low = begin + std::clamp<int64_t>(i + away_, 0, search_.count - 1);
    const int64_t* high = low;
    for (int64_t step = 1; low > begin && *low >= pixel; step *= 2) low -= std::min<int64_t>(step, low - begin);
    for (int64_t step = 1; high < end && *high < pixel; step *= 2) high += std::min<int64_t>(step, end - high);
    const int64_t found = std::lower_bound(low, high, pixel) - begin;
    away_ = found - i;
    return found;
  }

 private:
  const Search& search_;
  int64_t away_ = 0;
};

// Whether point i has enough neighbours in the image rows around its own, near rows first. `seekers` has one search for
// each row. Looks at kColumnsAround pixels to both sides; in a narrower image the looks would overlap, and count points
// twice and point i itself.
constexpr int kRowsAround = 8;
constexpr int64_t kColumnsAround = 4, kNarrowest = 2 * kColumnsAround + 1;
bool enough_in_rows(const Search& search, PixelSearch* seekers, int64_t i) {
  const float* q = search.points + 3 * i;
  int64_t found = 1;
  for (int r = 0; r < 2 * kRowsAround; ++r) {
    const int64_t rows_away = (r % 2 ? 1 : -1) * (r / 2 + 1);
    const int64_t first = search.pixel[i] + rows_away * search.width - kColumnsAround;
    for (int64_t other = seekers[r].seek(first, i);
         other < search.count && search.pixel[other] <= first + 2 * kColumnsAround; ++other) {
      const float* p = search.points + 3 * other;
      found += squared_distance(p[0], p[1], p[2], q[0], q[1], q[2]) < search.limit;
    }
    if (found >= search.enough) return true;
  }
  return false;
}

// Clear the mark of points with enough neighbours among the `close` points before and after them, then among `wide`,
// then in the image rows around them. Returns how many points of [begin, end) stay marked.
int64_t search_sequence(const Search& search, int64_t begin, int64_t end, int close, int wide) {
  Window window;
  window.load(search.points, search.count, begin - kMostAround);
  const int count = static_cast<int>(end - begin);
  const float limit = search.limit;
  uint8_t* outlier = search.outlier + begin;
  int32_t near[kPiece];
  std::fill(near, near + count, 1);
  for (int step = 1; step <= close; ++step)
    for (int i = 0; i < count; ++i) {
      const int slot = i + kMostAround;
      near[i] += window.near(slot, slot - step, limit) + window.near(slot, slot + step, limit);
    }
  int64_t left = 0;
  for (int i = 0; i < count; ++i) left += outlier[i] = near[i] < search.enough;
  // A piece whose points have few neighbours so close by in memory is in no order, and a wider look would be wasted.
  if (2 * left > count) return left;
  const bool has_rows = search.pixel != nullptr && search.width >= kNarrowest;
  std::vector<PixelSearch> seekers(has_rows ? 2 * kRowsAround : 0, PixelSearch(search));
  for (int i = 0; i < count; ++i) {
    if (!outlier[i]) continue;
    const int slot = i + kMostAround;
    int32_t found = 0;  // counts the point itself
    for (int other = slot - wide; other <= slot + wide; ++other) found += window.near(slot, other, limit);
    outlier[i] = found < search.enough && !(has_rows && enough_in_rows(search, seekers.data(), begin + i));
    left -= !outlier[i];
  }
  return left;
}

// Blocks of space twice the radius wide, hashed into a bitmap. Marking every block that a point's neighbours can lie in,
// at most two along each axis, leaves one look per point. Wider blocks, or two that share a bit, do no harm: they only
// pick points that turn out to be too far.
class Blocks {
 public:
  Blocks(const pc_context& context, ScratchFrame& scratch, const Box& box, float radius, int64_t marks) {
    double extent = 0;
    for (int axis = 0; axis < 3; ++axis) {
      low_[axis] = box.low[axis];
      extent = std::max(extent, static_cast<double>(box.high[axis]) - static_cast<double>(box.low[axis]));
    }
    per_length_ = static_cast<float>(1 / std::max(kSide * static_cast<double>(radius), extent / kMostPerAxis));
    // 64 bits per marking point, of which it sets at most 8.
    bits_ = std::clamp(bits_below<uint64_t>(static_cast<uint64_t>(marks) * 64), 12, 31);
    const int64_t words = int64_t{1} << (bits_ - 5);
    words_ = scratch.take<uint32_t>(words);
    parallel_for(context, words, 1 << 16,
                 [&](int64_t begin, int64_t end, int64_t) { std::fill(words_ + begin, words_ + end, 0u); });
  }

  void mark_around(const float* point) {  // many threads at once
    uint32_t first[3], last[3];
    for (int axis = 0; axis < 3; ++axis) {
      const float at = coordinate(point[axis], axis);
      first[axis] = static_cast<uint32_t>(at - kBlocksReach);
      last[axis] = static_cast<uint32_t>(at + kBlocksReach);
    }
    for (uint32_t x = first[0]; x <= last[0]; ++x)
      for (uint32_t y = first[1]; y <= last[1]; ++y)
        for (uint32_t z = first[2]; z <= last[2]; ++z) {
          const uint32_t bit = hash(x, y, z), mask = 1u << (bit & 31);
          uint32_t* word = words_ + (bit >> 5);
          if (!(__atomic_load_n(word, __ATOMIC_RELAXED) & mask)) __atomic_fetch_or(word, mask, __ATOMIC_RELAXED);
        }
  }

  // Write the points of [piece) in marked blocks to `rows`, rising; returns how many.
  int64_t pick(const float* points, Range piece, uint32_t* rows) const {
    Tile tile;
    alignas(64) uint32_t marked[kTile];
    int64_t picked = 0;
    for (int64_t begin = piece.begin; begin < piece.end; begin += kTile) {
      const int count = static_cast<int>(std::min<int64_t>(kTile, piece.end - begin));
      tile.load(points, nullptr, begin, count);
      uint32_t any = 0;
      for (int i = 0; i < count; ++i) {
        const uint32_t bit = hash(block(tile.x[i], 0), block(tile.y[i], 1), block(tile.z[i], 2));
        marked[i] = words_[bit >> 5] >> (bit & 31) & 1;
        any |= marked[i];
      }
      if (!any) continue;
      for (int i = 0; i < count; ++i) {
        rows[picked] = static_cast<uint32_t>(begin + i);
        picked += marked[i];
      }
    }
    return picked;
  }

 private:
  // Coordinates are float: up to 4097 blocks they err by less than 1e-3 of a block, and a neighbour is at most
  // 1 / kSide = 0.488 of a block away.
  static constexpr double kMostPerAxis = 4096, kSide = 2.05;
  static constexpr float kBlocksReach = 0.495f;

  // One block of room below, so that a neighbour's coordinate is not negative.
  float coordinate(float value, int axis) const { return (value - low_[axis]) * per_length_ + 1; }
  uint32_t block(float value, int axis) const {
    return static_cast<uint32_t>(static_cast<int32_t>(coordinate(value, axis)));
  }
  uint32_t hash(uint32_t x, uint32_t y, uint32_t z) const {  // multiplicative: large odd numbers spread the low bits up
    return (x * 0x9E3779B1u + y * 0x85EBCA77u + z * 0xC2B2AE3Du) * 0x2C1B3C6Du >> (32 - bits_);
  }

  float low_[3], per_length_;
  int bits_;
  uint32_t* words_;
};

// Clear the mark of every marked point with enough neighbours; `rows` picks the points that count, null = all.
template <class Key>
void search_cells(const pc_context& context, ScratchFrame& scratch, const Search& search, const Lattice& lattice,
                  const uint32_t* rows, int64_t count) {
  const Cells<Key> cells = sort_into_cells<Key>(context, scratch, lattice, search.points, rows, count);
  constexpr int64_t kGrain = 1024;
  parallel_for(context, count, kGrain, [&](int64_t begin, int64_t end, int64_t) {
    Neighborhood<Key> around(cells, kAllRows);
    for_each_cell(cells, begin, end, [&](int64_t cell, int64_t first, int64_t last) {
      const bool crowded = cells.size(cell) >= search.enough;
      if (!crowded) around.move_to(cell);
      for (int64_t i = first; i < last; ++i) {
        uint8_t& outlier = search.outlier[cells.row[i]];
        if (outlier && (crowded || has_near(cells, around, cell, i, search.limit, search.enough))) outlier = 0;
      }
    });
  });
}

struct Pick {
  const uint32_t* rows;  // null = all points
  int64_t count;
};

// The points that can be near a marked one, and the marked ones themselves.
Pick pick_around_marked(const pc_context& context, ScratchFrame& scratch, const Search& search, const Box& box,
                        int64_t marked) {
  Blocks blocks(context, scratch, box, search.radius, marked);
  std::vector<Range> pieces = even_pieces(context, search.count);
  const auto num_pieces = static_cast<int64_t>(pieces.size());
  parallel_for(context, num_pieces, 1, [&](int64_t p, int64_t, int64_t) {
    for (int64_t i = pieces[p].begin; i < pieces[p].end; ++i)
      if (search.outlier[i]) blocks.mark_around(search.points + 3 * i);
  });
  uint32_t* rows = scratch.take<uint32_t>(search.count);
  parallel_for(context, num_pieces, 1, [&](int64_t p, int64_t, int64_t) {
    pieces[p].end = pieces[p].begin + blocks.pick(search.points, pieces[p], rows + pieces[p].begin);
  });
  int64_t count = 0;
  for (const Range& piece : pieces) {
    std::memmove(rows + count, rows + piece.begin, static_cast<size_t>(piece.size()) * sizeof(uint32_t));
    count += piece.size();
  }
  return {rows, count};
}

// Decide one cloud; returns its largest cell coordinate, and decides nothing when that is too large.
double search_cloud(const pc_context& context, const Search& search) {
  ScratchFrame scratch;
  const Box box = parallel_bounds(context, search.points, search.count);
  const double side = cell_side(search.radius);
  const double largest = largest_coordinate(box, side);
  if (largest >= kMostCellsPerAxis) return largest;

  // Twice as many points as are needed; beyond this, cells are quicker.
  constexpr int64_t kMostClose = 16;
  std::atomic<int64_t> marked{0};
  if (const int64_t close = search.enough / 2 + 1; close <= kMostClose) {
    const int wide = std::min<int>(kMostAround, static_cast<int>(8 * close));
    parallel_for(context, search.count, kPiece, [&](int64_t begin, int64_t end, int64_t) {
      marked += search_sequence(search, begin, end, static_cast<int>(close), wide);
    });
  } else {
    marked = search.count;
    std::fill(search.outlier, search.outlier + search.count, uint8_t{1});
  }
  if (marked == 0) return largest;

  constexpr int64_t kFew = 8;  // picking pays while fewer than one point in this many is marked
  Pick pick{nullptr, search.count};
  if (marked < search.count / kFew) pick = pick_around_marked(context, scratch, search, box, marked);
  const Lattice lattice(box, side);
  if (lattice.fits_narrow())
    search_cells<NarrowKey>(context, scratch, search, lattice, pick.rows, pick.count);
  else
    search_cells<WideKey>(context, scratch, search, lattice, pick.rows, pick.count);
  return largest;
}

}  // namespace

// points (N, 3); ptr (B+1,); pixel (N,) rising within each cloud, or null; outlier (N,) out; largest (1,) out: the largest cell coordinate of any cloud. The mask is
// complete only if that is below 2^36.
PC_EXPORT int32_t pc_radius_outlier_mask(const pc_context* context, const float* points, const int64_t* ptr,
                                         int64_t clouds, double radius, int64_t min_neighbors, const int64_t* pixel,
                                         int64_t width, uint8_t* outlier, double* largest) {
  return guarded([&] {
    const auto narrow = static_cast<float>(radius);
    std::atomic<double> most{0};
    for_each_cloud(*context, ptr, clouds, [&](const pc_context& crew, int64_t first, int64_t count) {
      raise_to(most, search_cloud(crew, {points + 3 * first, count, narrow, narrow * narrow, min_neighbors + 1,
                                         outlier + first, pixel ? pixel + first : nullptr, width}));
    });
    *largest = most.load();
  });
}
