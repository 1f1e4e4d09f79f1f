// What the system should know about large results.
#include "pc/threads.hpp"

#ifdef __linux__
#include <sys/mman.h>
#endif

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
