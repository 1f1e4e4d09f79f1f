// What the system should know about large results.
#include "pc/common.hpp"

#ifdef __linux__
#include <sys/mman.h>
#endif

// Ask for huge pages in blocks that are about to be filled: a page fault costs more than filling its 4 KB, and a huge
// page takes one for 2 MB. Advice only, content stays. The huge pages at both ends count as well, or blocks of a few
// megabytes, one behind the other in the heap, would get half of theirs: what else lies there is already in memory, and
// stays as it is, or is free.
PC_EXPORT int32_t pc_advise_huge_pages(const pc_context*, int64_t count, const int64_t* addresses,
                                       const int64_t* bytes) {
  return pc::guarded([&] {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    constexpr int64_t kHuge = 2 << 20;
    for (int64_t i = 0; i < count; ++i) {
      if (bytes[i] < kHuge) continue;
      const int64_t begin = addresses[i] / kHuge * kHuge;
      const int64_t end = (addresses[i] + bytes[i] + kHuge - 1) / kHuge * kHuge;
      (void)madvise(reinterpret_cast<void*>(begin), static_cast<size_t>(end - begin), MADV_HUGEPAGE);
    }
#else
    (void)count, (void)addresses, (void)bytes;
#endif
  });
}
