// Finding the rows of blocks by their keys, and packing colors as voxels store them.
#include <algorithm>

#include "pc/math/voxel_block.hpp"
#include "pc/threads.hpp"

namespace pc::tsdf {
namespace {

// Rows of blocks by their keys: open addressing, at most half full. A slot holds a row, or -1.
struct RowTable {
  const int64_t* keys;  // of all rows
  int32_t* slots;
  int64_t num_slots;  // a power of two

  int64_t first(int64_t key) const {
    const int shift = 64 - __builtin_ctzll(static_cast<uint64_t>(num_slots));
    return math::first_place(key, shift);
  }
  void add(int64_t row) {
    int64_t at = first(keys[row]);
    while (slots[at] >= 0) at = (at + 1) & (num_slots - 1);
    slots[at] = static_cast<int32_t>(row);
  }
  int64_t find(int64_t key) const {
    int64_t at = first(key);
    while (slots[at] >= 0 && keys[slots[at]] != key) at = (at + 1) & (num_slots - 1);
    return slots[at];
  }
  // A look leads from a slot to a key, both somewhere in memory: go a step at a time.
  void prefetch_slot(int64_t key) const { __builtin_prefetch(slots + first(key)); }
  void prefetch_key(int64_t key) const { __builtin_prefetch(keys + std::max<int32_t>(0, slots[first(key)])); }
};

}  // namespace
}  // namespace pc::tsdf

PC_EXPORT int32_t pc_tsdf_find(const pc_context*, const int64_t* keys, int64_t num_blocks, int32_t* slots,
                               int64_t num_slots, int64_t num_known, const int64_t* wanted, int64_t num_wanted,
                               int64_t* rows, int64_t* missing, int64_t* count) {
  using namespace pc;
  using namespace pc::tsdf;
  return guarded([&] {
    constexpr int64_t kSlots = 24, kKeys = 12;  // ahead
    RowTable table{keys, slots, num_slots};
    for (int64_t row = num_known; row < num_blocks; ++row) {
      if (row + kSlots < num_blocks) table.prefetch_slot(keys[row + kSlots]);
      table.add(row);
    }
    int64_t none = 0;
    for (int64_t i = 0; i < num_wanted; ++i) {
      if (i + kSlots < num_wanted) table.prefetch_slot(wanted[i + kSlots]);
      if (i + kKeys < num_wanted) table.prefetch_key(wanted[i + kKeys]);
      rows[i] = table.find(wanted[i]);
      missing[none] = wanted[i];
      none += rows[i] < 0;
    }
    *count = none;
  });
}

PC_EXPORT int32_t pc_tsdf_pack_colors(const pc_context*, const uint8_t* colors, int64_t count, int32_t* packed) {
  using namespace pc;
  using namespace pc::tsdf;
  return guarded([&] {
    for (int64_t i = 0; i < count; ++i)
      packed[i] = colors[3 * i] << 2 | colors[3 * i + 1] << 12 | colors[3 * i + 2] << 22;
  });
}
