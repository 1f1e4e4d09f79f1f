// Records of stored groups: where the rows of many lie, and copies of them one after another.
#include <cstring>

#include "pc/rows/streamed_copy.hpp"
#include "pc/threads.hpp"

namespace pc::records {
namespace {

constexpr int64_t kAligned = 64;             // bytes: where columns begin
constexpr int64_t kStreamedBytes = 1 << 20;  // from here on the caches would lose all else that they hold
constexpr int64_t kBlocksPerPiece = 8;

enum Role : int64_t { kAnyRows, kRowPerPoint, kRowPerCloud, kPointers, kText };
enum Kind : int64_t { kOthers, kRows, kClouds };

// The table that pc_find_records writes, as pcdata/functional/stored_rows.py has it.
struct Found {
  int64_t *kind, *pointers, *starts, *ends, *sources, *sizes;

  Found(int64_t* table, int64_t columns, int64_t records)
      : kind(table),
        pointers(table + 1),
        starts(table + 2),
        ends(starts + columns + 1),
        sources(ends + columns * records),
        sizes(sources + columns * records) {}
};

struct Rows {
  int64_t source, first, count;
};

// The rows of a record in a column of its group: (address, rows of every record, place of its pointers or -1).
Rows rows_of(const int64_t* column, const int64_t* pointers, int64_t record) {
  if (column[2] < 0) return {column[0], column[1] * record, column[1]};
  const int64_t* own = pointers + column[2] + record;
  return {column[0], own[0], own[1] - own[0]};
}

}  // namespace
}  // namespace pc::records

PC_EXPORT int32_t pc_find_records(const pc_context*, const int64_t* places, int64_t num_records, const int64_t* firsts,
                                  const int64_t* which, int64_t num_groups, int64_t form, const int64_t* tables,
                                  const int64_t* pointers, int64_t num_columns, const int64_t* row_bytes,
                                  const int64_t* roles, int64_t* table) {
  using namespace pc;
  using namespace pc::records;
  return guarded([&] {
    const Found found(table, num_columns, num_records);
    *found.kind = kOthers;
    *found.pointers = -1;
    int64_t clouds = 1;  // whether every record is one cloud
    for (int64_t c = 0; c < num_columns; ++c)
      if (roles[c] == kPointers) *found.pointers = c;
    if (*found.pointers < 0) clouds = 0;
    for (int64_t r = 0; r < num_records; ++r) {
      const int64_t group = std::upper_bound(firsts, firsts + num_groups, places[r]) - firsts - 1;
      if (which[2 * group] != form) return;
      const int64_t* columns = tables + 3 * num_columns * which[2 * group + 1];
      const int64_t record = places[r] - firsts[group];
      int64_t points = -1;
      if (clouds != 0) {
        const Rows own = rows_of(columns + 3 * *found.pointers, pointers, record);
        int64_t ptr[2] = {-1, -1};
        if (own.count == 2) std::memcpy(ptr, reinterpret_cast<const char*>(own.source + 8 * own.first), sizeof ptr);
        clouds &= ptr[0] == 0;
        points = ptr[1];
      }
      for (int64_t c = 0; c < num_columns; ++c) {
        const Rows own = rows_of(columns + 3 * c, pointers, record);
        const int64_t at = c * num_records + r;
        found.sources[at] = own.source + own.first * row_bytes[c];
        found.sizes[at] = own.count * row_bytes[c];
        found.ends[at] = own.count + (r == 0 ? 0 : found.ends[at - 1]);
        if (roles[c] == kRowPerPoint) clouds &= own.count == points;
        if (roles[c] == kRowPerCloud) clouds &= own.count == 1;
        if (roles[c] == kText) clouds &= own.count > 0;
      }
    }
    *found.kind = clouds != 0 ? kClouds : kRows;
    int64_t begin = 0;
    for (int64_t c = 0; c < num_columns; ++c) {
      found.starts[c] = begin;
      const int64_t last = c * num_records + num_records - 1;
      int64_t bytes = num_records == 0 ? 0 : found.ends[last] * row_bytes[c];
      if (clouds != 0 && c == *found.pointers) bytes = 8 * (num_records + 1);
      begin += (bytes + kAligned - 1) / kAligned * kAligned;
    }
    found.starts[num_columns] = begin;
  });
}

PC_EXPORT int32_t pc_gather_records(const pc_context* context, int64_t num_records, int64_t num_columns,
                                    const int64_t* row_bytes, const int64_t* roles, const int64_t* table,
                                    uint8_t* into) {
  using namespace pc;
  using namespace pc::records;
  return guarded([&] {
    const Found found(const_cast<int64_t*>(table), num_columns, num_records);
    const int64_t joined = *found.kind == kClouds ? *found.pointers : -1;
    const bool streamed = found.starts[num_columns] >= kStreamedBytes;
    parallel_for(*context, num_columns * num_records, kBlocksPerPiece, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t at = first; at < last; ++at) {
        const int64_t column = at / num_records;
        if (column == joined || found.sizes[at] <= 0) continue;
        char* to =
            reinterpret_cast<char*>(into) + found.starts[column] + found.ends[at] * row_bytes[column] - found.sizes[at];
        const auto* from = reinterpret_cast<const char*>(found.sources[at]);
        const auto size = static_cast<size_t>(found.sizes[at]);
        streamed ? rows::copy_streamed(to, from, size) : static_cast<void>(std::memcpy(to, from, size));
      }
      if (streamed) rows::end_streamed();
    });
    if (joined < 0) return;
    int64_t points = -1;
    for (int64_t c = 0; c < num_columns; ++c)
      if (roles[c] == kRowPerPoint) points = c;
    std::memset(into + found.starts[joined], 0, 8);
    std::memcpy(into + found.starts[joined] + 8, found.ends + points * num_records,
                static_cast<size_t>(8 * num_records));
  });
}
