// Radius outliers: points with too few neighbors, found without counting more of them than it takes to decide.
//
// 1. Points that follow one another in memory are near one another when they come from a depth image, so nearly all
//    find enough neighbors among the next few before and after them, and nearly all others, where the image is known,
//    in the rows above and below. Any hit is a real neighbor: no proof needed, and a wrong image would do no harm.
// 2. What is left (depth edges, strays) needs only the points around it, picked by a bitmap of coarse blocks of space.
// 3. Those are sorted into cells; a cell with enough points decides itself, other points count the cells around them.
//
// Of points in no order cells that hold enough points are found by counting first, and others looked for among some.
#include <iterator>

#include "pc/bounds.hpp"
#include "pc/cells/block_bitmap.hpp"
#include "pc/cells/cell_counts.hpp"
#include "pc/cells/marked_sequence.hpp"
#include "pc/cells/neighborhood.hpp"
#include "pc/rows/kept.hpp"

namespace pc::cells {
namespace {

// Clear the mark of every marked point with enough neighbors; `rows` picks the points that count, null = all.
template <class Key>
void search_cells(const pc_context& context, ScratchFrame& scratch, const RadiusSearch& search, const Lattice& lattice,
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
Pick pick_around_marked(const pc_context& context, ScratchFrame& scratch, const RadiusSearch& search,
                        const math::Bounds& box, int64_t marked) {
  BlockBitmap blocks(context, scratch, box, search.radius, marked);
  std::vector<Range> pieces = even_pieces(context, search.count);
  const auto num_pieces = static_cast<int64_t>(pieces.size());
  parallel_for(context, num_pieces, 1, [&](int64_t p, int64_t, int64_t) {
    for_each_marked(search.outlier, pieces[p].begin, pieces[p].end,
                    [&](int64_t i) { blocks.mark_around(search.points + 3 * i); });
  });
  uint32_t* rows = scratch.take<uint32_t>(search.count);
  parallel_for(context, num_pieces, 1, [&](int64_t p, int64_t, int64_t) {
    pieces[p].end = pieces[p].begin + blocks.pick(search.points, search.within, pieces[p], rows + pieces[p].begin);
  });
  int64_t count = 0;
  for (const Range& piece : pieces) {
    std::memmove(rows + count, rows + piece.begin, static_cast<size_t>(piece.size()) * sizeof(uint32_t));
    count += piece.size();
  }
  return {rows, count};
}

// One point in sixteen, and the marked ones: in a crowded place even so few show that a point is not alone.
Pick pick_some_and_marked(ScratchFrame& scratch, const RadiusSearch& search) {
  constexpr int64_t kRun = 16, kEvery = 16 * kRun;
  uint32_t* rows = scratch.take<uint32_t>(search.count);
  int64_t count = 0;
  for (int64_t i = 0; i < search.count; ++i) {
    rows[count] = static_cast<uint32_t>(i);
    count += ((i % kEvery < kRun) | search.outlier[i]) & search.has(i);
  }
  return {rows, count};
}

Pick pick_all(ScratchFrame& scratch, const RadiusSearch& search) {
  if (search.within == nullptr) return {nullptr, search.count};
  uint32_t* rows = scratch.take<uint32_t>(search.count);
  int64_t count = 0;
  for (int64_t i = 0; i < search.count; ++i) {
    rows[count] = static_cast<uint32_t>(i);
    count += search.has(i);
  }
  return {rows, count};
}

// Mark what has few neighbors before and after it in memory; returns how many points those are. The box around all
// points is found in the same pass.
int64_t mark_by_sequence(const pc_context& context, const RadiusSearch& search, math::Bounds& box) {
  // Twice as many points as are needed; beyond this, cells are quicker.
  constexpr int64_t kMostClose = 16;
  const int64_t close = search.enough / 2 + 1;
  const int wide = std::min<int>(kMostAround, static_cast<int>(8 * close));
  const auto mark = [&](int64_t begin, int64_t end) {
    return search_sequence(search, begin, end, static_cast<int>(close), wide);
  };
  // Whether points are in an order shows in some of the pieces.
  constexpr int64_t kTried = 32, kPiecesPerTry = 16;
  bool in_order = close <= kMostClose && search.count < kTried * kPiecesPerTry * kPiece;
  if (!in_order && close <= kMostClose) {
    for (int64_t t = 0; t < kTried && !in_order; ++t) {
      const int64_t begin = search.count / kTried * t;
      in_order = 2 * mark(begin, begin + kPiece) <= kPiece;
    }
  }
  if (!in_order) {
    box = parallel_bounds(context, search.points, search.count);
    std::fill(search.outlier, search.outlier + search.count, uint8_t{1});
    if (search.within == nullptr) return search.count;
    int64_t all = 0;
    for (int64_t i = 0; i < search.count; ++i) all += search.outlier[i] = search.has(i);
    return all;
  }
  std::atomic<int64_t> marked{0};
  std::vector<math::Bounds> boxes(static_cast<size_t>((search.count + kPiece - 1) / kPiece));
  parallel_for(context, search.count, kPiece, [&](int64_t begin, int64_t end, int64_t) {
    marked += mark(begin, end);
    boxes[static_cast<size_t>(begin / kPiece)] = bounds_of(search.points, begin, end);
  });
  box = hull(boxes);
  return marked;
}

// Decide one cloud; returns its largest cell coordinate, and decides nothing when that is too large.
double search_cloud(const pc_context& context, const RadiusSearch& search) {
  ScratchFrame scratch;
  math::Bounds box;
  int64_t marked = mark_by_sequence(context, search, box);
  const double side = cell_side(search.radius);
  double largest = largest_coordinate(box, side);
  if (largest >= kMostCellsPerAxis && search.within != nullptr) {  // what is far out may be no point
    const Pick there = pick_all(scratch, search);
    if (there.count == 0) return 0;
    box = math::Bounds::of_point(search.points + 3 * int64_t{there.rows[0]});
    for (int64_t i = 1; i < there.count; ++i) box.include(search.points + 3 * int64_t{there.rows[i]});
    largest = largest_coordinate(box, side);
  }
  if (largest >= kMostCellsPerAxis) return largest;
  if (marked == 0) return largest;

  constexpr int64_t kFew = 8;     // picking pays while fewer than one point in this many is marked
  constexpr int64_t kSome = 128;  // a look at some of the points first pays from here on
  constexpr int64_t kManyPoints = 1 << 13;
  const Lattice lattice(box, side);
  const auto search_among = [&](Pick pick) {
    if (lattice.fits_narrow())
      search_cells<NarrowKey>(context, scratch, search, lattice, pick.rows, pick.count);
    else
      search_cells<WideKey>(context, scratch, search, lattice, pick.rows, pick.count);
  };
  const bool many = search.count >= kManyPoints;
  if (many && marked >= search.count / kFew)
    marked = clear_crowded(context, lattice, search.points, search.within, search.count, search.enough, search.outlier);
  if (marked == 0) return largest;
  if (marked >= search.count / kFew) {
    search_among(pick_all(scratch, search));
    return largest;
  }
  if (many && marked > search.count / kSome) {
    search_among(pick_some_and_marked(scratch, search));
    marked = std::count(search.outlier, search.outlier + search.count, uint8_t{1});
    if (marked == 0) return largest;
  }
  search_among(pick_around_marked(context, scratch, search, box, marked));
  return largest;
}

}  // namespace
}  // namespace pc::cells

PC_EXPORT int32_t pc_radius_outlier_mask(const pc_context* context, const float* points, const int64_t* ptr,
                                         int64_t clouds, double radius, int64_t min_neighbors, const int64_t* pixel,
                                         int64_t width, const uint8_t* within, uint8_t* marks, int64_t* kept_ptr,
                                         int64_t* sums, double* largest) {
  using namespace pc;
  using namespace pc::cells;
  return guarded([&] {
    const auto narrow = static_cast<float>(radius);
    std::atomic<double> most{0};
    for_each_cloud(*context, ptr, clouds, [&](const pc_context& own, int64_t first, int64_t count) {
      raise_to(most,
               search_cloud(own, {points + 3 * first, count, narrow, narrow * narrow, min_neighbors + 1, marks + first,
                                  pixel ? pixel + first : nullptr, width, within ? within + first : nullptr}));
    });
    *largest = most.load();
    if (kept_ptr != nullptr) rows::mark_kept(*context, marks, true, within, ptr, clouds, {marks, kept_ptr, sums});
  });
}
