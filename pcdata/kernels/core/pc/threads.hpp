// The threads of a kernel call: how a call begins and ends, and how its work is shared out.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>
#include <type_traits>
#include <utility>
#include <vector>

#include "pc/exports.hpp"

namespace pc {

using std::int32_t;
using std::int64_t;
using std::uint32_t;
using std::uint64_t;
using std::uint8_t;

// -- a call -------------------------------------------------------------------------------------------------------

enum Status : int32_t { kOk = 0, kOutOfMemory = 1, kInterrupted = 2, kFailed = 3, kTooManyRows = 4 };

struct Interrupted : std::exception {};
struct TooManyRows : std::exception {};

// Rows, cells and pixels are numbered in 31 bits: half the memory of 64, and one bit is left to mark them.
constexpr int64_t kMaxRows = (int64_t{1} << 31) - 1;

// What numbers rows so asks this first, before it takes memory for them.
inline void require_numbered(int64_t rows) {
  if (rows > kMaxRows) throw TooManyRows();
}

int32_t run_call(void* body, void (*call)(void*)) noexcept;

// Run a kernel's body and turn its end into a status: no exception crosses the C interface.
template <class Body>
int32_t guarded(Body&& body) noexcept {
  using Plain = std::remove_reference_t<Body>;
  return run_call(&body, [](void* object) { (*static_cast<Plain*>(object))(); });
}

// Asks Python for an interrupt at most every 20 ms; used by the calling thread only.
class Poll {
 public:
  explicit Poll(const pc_context& context);

  void check();  // throws Interrupted

 private:
  const pc_context& context_;
  int64_t next_;  // nanoseconds
};

// -- sharing out work ---------------------------------------------------------------------------------------------

// A body to call for pieces of work, without its type: what shares work out is compiled once, not for every body.
struct PieceBody {
  void* object;
  void (*call)(void* object, int64_t begin, int64_t end, int64_t thread);

  void operator()(int64_t begin, int64_t end, int64_t thread) const { call(object, begin, end, thread); }
};

void run_pieces(const pc_context& context, int64_t count, int64_t grain, PieceBody body);

// Call body(begin, end, thread) over [0, count) in pieces of `grain` by up to context.threads threads. Pieces may run
// in any order, so bodies write disjoint results. A long piece delays Ctrl-C: keep it well under a second.
//
// Every thread has a stretch of its own, the same in every loop over the same pieces, so that it meets what it has in
// its cache; one that is done helps the others.
template <class Body>
void parallel_for(const pc_context& context, int64_t count, int64_t grain, Body&& body) {
  using Plain = std::remove_const_t<std::remove_reference_t<Body>>;
  auto* object = const_cast<Plain*>(&body);
  run_pieces(context, count, grain, {object, [](void* it, int64_t begin, int64_t end, int64_t thread) {
                                       (*static_cast<Plain*>(it))(begin, end, thread);
                                     }});
}

struct Range {
  int64_t begin, end;
  int64_t size() const { return end - begin; }
};

// Cut [0, count) into a few equal pieces per thread, so that a slow core does not hold the others up. Pieces too small
// for a thread of their own are not made; very large ones are cut further, for Ctrl-C.
std::vector<Range> even_pieces(const pc_context& context, int64_t count);

// -- ragged batches: long clouds cut into several pieces, short ones whole ----------------------------------------

// A run of rows of one cloud.
struct CloudPiece {
  int64_t cloud, begin, end;
};

// All clouds cut into pieces of at most `rows` rows, in order; an empty cloud has none.
std::vector<CloudPiece> cut_clouds(const int64_t* ptr, int64_t num_clouds, int64_t rows);

// Call body(piece, its number) for all pieces, about `rows` rows at a time.
template <class Body>
void for_each_piece(const pc_context& context, const std::vector<CloudPiece>& pieces, int64_t rows, Body&& body) {
  if (pieces.empty()) return;
  const auto count = static_cast<int64_t>(pieces.size());
  const int64_t mean = std::max<int64_t>(1, (pieces.back().end - pieces.front().begin) / count);
  parallel_for(context, count, std::max<int64_t>(1, rows / mean), [&](int64_t first, int64_t last, int64_t) {
    for (int64_t p = first; p < last; ++p) body(pieces[static_cast<size_t>(p)], p);
  });
}

}  // namespace pc
