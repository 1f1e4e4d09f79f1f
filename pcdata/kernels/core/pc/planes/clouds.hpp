// Clouds of a batch, each with work of its own.
#pragma once

#include "pc/threads.hpp"

namespace pc::planes {

// Points; clouds of no more are worked on side by side, each by one thread.
constexpr int64_t kSmallCloud = 8192;

// Call find(context, cloud) for all clouds; `grain` small ones are taken at a time. Large ones get all threads.
template <class Find>
void for_each_cloud(const pc_context& context, const int64_t* ptr, int64_t num_clouds, int64_t grain,
                    const Find& find) {
  for (int64_t cloud = 0; cloud < num_clouds; ++cloud) require_numbered(ptr[cloud + 1] - ptr[cloud]);
  const auto is_small = [&](int64_t cloud) { return ptr[cloud + 1] - ptr[cloud] <= kSmallCloud; };
  const pc_context alone{1, nullptr};  // who shares the clouds out asks for Ctrl-C
  parallel_for(context, num_clouds, grain, [&](int64_t begin, int64_t end, int64_t) {
    for (int64_t cloud = begin; cloud < end; ++cloud)
      if (is_small(cloud)) find(alone, cloud);
  });
  for (int64_t cloud = 0; cloud < num_clouds; ++cloud)
    if (!is_small(cloud)) find(context, cloud);
}

}  // namespace pc::planes
