// Ragged batches cut into pieces of work: long clouds into several, short ones whole.
#pragma once

#include "pc/common.hpp"

namespace pc {

// A run of rows of one cloud.
struct CloudPiece {
  int64_t cloud, begin, end;
};

// All clouds cut into pieces of at most `rows` rows, in order; an empty cloud has none.
inline std::vector<CloudPiece> cut_clouds(const int64_t* ptr, int64_t num_clouds, int64_t rows) {
  std::vector<CloudPiece> pieces;
  for (int64_t cloud = 0; cloud < num_clouds; ++cloud)
    for (int64_t begin = ptr[cloud]; begin < ptr[cloud + 1]; begin += rows)
      pieces.push_back({cloud, begin, std::min(ptr[cloud + 1], begin + rows)});
  return pieces;
}

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
