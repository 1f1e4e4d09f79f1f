// Picking rows of many fields at once: by index, or by a mask that keeps their order.
#include <cstring>
#include <type_traits>

#include "pc/rows/kept.hpp"
#include "pc/rows/runs.hpp"
#include "pc/threads.hpp"

namespace pc::rows {
namespace {

// Fields of N rows and their picked rows. Rows are copied as bytes, so any dtype and shape will do.
struct Fields {
  int64_t count;
  const int64_t* sources;  // addresses
  const int64_t* row_bytes;
  const int64_t* picked;  // addresses

  template <class Body>
  void each(const Body& body) const {
    for (int64_t f = 0; f < count; ++f)
      body(reinterpret_cast<const char*>(sources[f]), row_bytes[f], reinterpret_cast<char*>(picked[f]));
  }
};

// Call body with the row size as a compile-time constant where it is a usual one: then a copy is a load and a store.
template <class Body>
void with_row_size(int64_t bytes, const Body& body) {
  switch (bytes) {
    case 1:
      return body(std::integral_constant<int64_t, 1>());
    case 4:
      return body(std::integral_constant<int64_t, 4>());
    case 8:
      return body(std::integral_constant<int64_t, 8>());
    case 12:
      return body(std::integral_constant<int64_t, 12>());
    default:
      return body(bytes);
  }
}

// Copy runs of rows one after another; `picked` may lie before the rows in the same memory, or where they begin.
void copy_runs(const char* source, int64_t bytes, const Run* runs, int64_t num_runs, char* picked) {
  for (int64_t r = 0; r < num_runs; ++r) {
    const auto size = static_cast<size_t>(runs[r].length * bytes);
    std::memmove(picked, source + runs[r].start * bytes, size);
    picked += size;
  }
}

// Copy the rows of a mask one after another, likewise; rows of one word, two or three.
template <int kWords>
void copy_kept(const char* source, const uint8_t* mask, int64_t first, int64_t last, char* picked) {
  constexpr int64_t kBytes = 4 * kWords;
  int32_t packed[kWords * kStretch + kLanes];
  for (int64_t begin = first; begin < last; begin += kStretch) {
    const int64_t count = std::min(kStretch, last - begin);
    const int64_t kept = pack_rows<kWords>(source + begin * kBytes, mask + begin, count, packed);
    std::memcpy(picked, packed, static_cast<size_t>(kept * kBytes));
    picked += kept * kBytes;
  }
}

}  // namespace
}  // namespace pc::rows

PC_EXPORT int32_t pc_kept_rows(const pc_context* context, const uint8_t* marks, int64_t gone, const uint8_t* within,
                               const int64_t* ptr, int64_t num_clouds, uint8_t* keep, int64_t* kept_ptr,
                               int64_t* sums) {
  using namespace pc;
  using namespace pc::rows;
  return guarded([&] { mark_kept(*context, marks, gone != 0, within, ptr, num_clouds, {keep, kept_ptr, sums}); });
}

PC_EXPORT int32_t pc_keep_rows(const pc_context* context, const uint8_t* mask, int64_t rows, int64_t room,
                               int64_t num_fields, const int64_t* sources, const int64_t* row_bytes,
                               const int64_t* picked, int64_t* kept) {
  using namespace pc;
  using namespace pc::rows;
  return guarded([&] {
    ScratchFrame scratch;
    const int64_t pieces = (rows + kRowsPerPiece - 1) / kRowsPerPiece;
    int64_t* starts = scratch.take<int64_t>(pieces + 1);
    starts[0] = 0;
    parallel_for(*context, rows, kRowsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      int64_t count = 0;
      for (int64_t row = first; row < last; ++row) count += mask[row] != 0;
      starts[first / kRowsPerPiece + 1] = count;
    });
    for (int64_t piece = 0; piece < pieces; ++piece) starts[piece + 1] += starts[piece];
    *kept = starts[pieces];
    if (*kept > room) return;
    const Fields fields{num_fields, sources, row_bytes, picked};
    bool in_place = false;
    for (int64_t f = 0; f < num_fields; ++f) in_place |= sources[f] == picked[f];
    // In the same memory a piece writes where the rows of those before it were.
    const pc_context alone{1, context->poll};
    parallel_for(in_place ? alone : *context, rows, kRowsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      Run runs[kRowsPerPiece / 2];
      const int64_t start = starts[first / kRowsPerPiece];
      int64_t num_runs = -1;
      fields.each([&](const char* source, int64_t row_size, char* to) {
        to += start * row_size;
        if (row_size == 12) return copy_kept<3>(source, mask, first, last, to);
        if (row_size == 8) return copy_kept<2>(source, mask, first, last, to);
        if (row_size == 4) return copy_kept<1>(source, mask, first, last, to);
        if (num_runs < 0) num_runs = find_runs(mask, first, last, runs);
        copy_runs(source, row_size, runs, num_runs, to);
      });
    });
  });
}

PC_EXPORT int32_t pc_gather_kept(const pc_context* context, const int64_t* ptr, int64_t num_clouds, const uint8_t* kept,
                                 const int64_t* kept_ptr, int64_t num_fields, const int64_t* sources,
                                 const int64_t* row_bytes, const int64_t* picked) {
  using namespace pc;
  using namespace pc::rows;
  return guarded([&] {
    parallel_for(*context, num_clouds, 1, [&](int64_t first_cloud, int64_t last_cloud, int64_t) {
      Run runs[kRowsPerPiece / 2];
      for (int64_t cloud = first_cloud; cloud < last_cloud; ++cloud) {
        const uint8_t* mask = kept + ptr[cloud];
        const int64_t count = ptr[cloud + 1] - ptr[cloud];
        for (int64_t f = 0; f < num_fields; ++f) {
          const auto* source = reinterpret_cast<const char*>(sources[f * num_clouds + cloud]);
          char* to = reinterpret_cast<char*>(picked[f]) + kept_ptr[cloud] * row_bytes[f];
          if (row_bytes[f] == 12) {
            copy_kept<3>(source, mask, 0, count, to);
          } else if (row_bytes[f] == 8) {
            copy_kept<2>(source, mask, 0, count, to);
          } else if (row_bytes[f] == 4) {
            copy_kept<1>(source, mask, 0, count, to);
          } else {
            for (int64_t begin = 0; begin < count; begin += kRowsPerPiece) {
              const int64_t num_runs = find_runs(mask, begin, std::min(count, begin + kRowsPerPiece), runs);
              copy_runs(source, row_bytes[f], runs, num_runs, to);
              for (int64_t r = 0; r < num_runs; ++r) to += runs[r].length * row_bytes[f];
            }
          }
        }
      }
    });
  });
}

PC_EXPORT int32_t pc_take_rows(const pc_context* context, const int64_t* index, int64_t num_picked, int64_t rows,
                               int64_t num_fields, const int64_t* sources, const int64_t* row_bytes,
                               const int64_t* picked, int64_t* possible) {
  using namespace pc;
  using namespace pc::rows;
  return guarded([&] {
    const Fields fields{num_fields, sources, row_bytes, picked};
    std::atomic<bool> inside{true};
    parallel_for(*context, num_picked, kRowsPerPiece, [&](int64_t first, int64_t last, int64_t) {
      bool wrong = false;
      for (int64_t i = first; i < last; ++i) wrong |= index[i] < 0 || index[i] >= rows;
      if (wrong) {
        inside.store(false, std::memory_order_relaxed);
        return;
      }
      fields.each([&](const char* source, int64_t row_size, char* to) {
        with_row_size(row_size, [&](auto bytes) {
          for (int64_t i = first; i < last; ++i)
            std::memcpy(to + i * bytes, source + index[i] * bytes, static_cast<size_t>(bytes));
        });
      });
    });
    *possible = inside;
  });
}

PC_EXPORT int32_t pc_place_rows(const pc_context* context, int64_t num_parts, const int64_t* counts,
                                const int64_t* starts, int64_t num_fields, const int64_t* sources,
                                const int64_t* row_bytes, const int64_t* fillers, const int64_t* blocks) {
  using namespace pc;
  using namespace pc::rows;
  return guarded([&] {
    const int64_t rows = std::max<int64_t>(1, starts[num_parts] / std::max<int64_t>(1, num_parts));
    const int64_t parts_per_piece = std::max<int64_t>(1, kRowsPerPiece / rows);
    parallel_for(*context, num_parts, parts_per_piece, [&](int64_t first, int64_t last, int64_t) {
      for (int64_t part = first; part < last; ++part) {
        for (int64_t field = 0; field < num_fields; ++field) {
          const int64_t bytes = row_bytes[field];
          const auto filled = static_cast<size_t>(counts[part] * bytes);
          const auto all = static_cast<size_t>((starts[part + 1] - starts[part]) * bytes);
          char* to = reinterpret_cast<char*>(blocks[field]) + starts[part] * bytes;
          if (filled != 0) std::memcpy(to, reinterpret_cast<const char*>(sources[field * num_parts + part]), filled);
          if (all != filled) std::memset(to + filled, static_cast<int>(fillers[field]), all - filled);
        }
      }
    });
  });
}
