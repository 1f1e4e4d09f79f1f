// What the system should know about large results.
#include "pc/common.hpp"

#ifdef __linux__
#include <sys/mman.h>
#endif

// Ask for huge pages in blocks that are about to be filled: a page fault costs more than filling its 4 KB, and a huge
// page takes one for 2 MB. Advice only, for whole huge pages inside the blocks and inside runs of blocks that the
// allocator put one after another; their content stays.
PC_EXPORT int32_t pc_advise_huge_pages(const pc_context*, int64_t count, const int64_t* addresses,
                                       const int64_t* bytes) {
  return pc::guarded([&] {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    constexpr int64_t kHuge = 2 << 20, kHeader = 256;  // what an allocator may put between two blocks
    std::vector<std::pair<int64_t, int64_t>> blocks;
    for (int64_t i = 0; i < count; ++i) blocks.emplace_back(addresses[i], addresses[i] + bytes[i]);
    std::sort(blocks.begin(), blocks.end());
    for (size_t i = 0; i < blocks.size();) {
      const int64_t begin = blocks[i].first / kHuge * kHuge;
      int64_t end = blocks[i].second;
      for (++i; i < blocks.size() && blocks[i].first - end <= kHeader; ++i) end = blocks[i].second;
      end = (end + kHuge - 1) / kHuge * kHuge;
      if (end > begin) (void)madvise(reinterpret_cast<void*>(begin), static_cast<size_t>(end - begin), MADV_HUGEPAGE);
    }
#else
    (void)count, (void)addresses, (void)bytes;
#endif
  });
}
