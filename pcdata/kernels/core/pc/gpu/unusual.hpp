// Which mean distances are unusual for their cloud.
#pragma once

#include "pc/gpu/rows.hpp"

namespace pc::gpu {

constexpr int kRuns = 1024;  // interleaved sums, as the reference has them: threads of a block

// The sum of value(0), value(1), ... in interleaved runs, halves of which are added to each other: the reference's
// bits.
template <class Value>
PC_HD double interleaved_sum(double* runs, int64_t count, Value&& value) {
  const int own = thread_in_block();
  double sum = 0;
  for (int64_t i = own; i < count; i += kRuns) sum += value(i);
  runs[own] = sum;
  for (int half = kRuns / 2; half > 0; half /= 2) {
    sync_block();
    if (own < half) runs[own] += runs[own + half];
  }
  sync_block();
  sum = runs[0];
  sync_block();  // or one begins to write what another has yet to read
  return sum;
}

// One block of kRuns threads for each cloud.
PC_BLOCK_KERNEL(pc_mark_unusual, const double* means, const int64_t* ptr, double ratio, uint8_t* outlier) {
  PC_SHARED(double, runs, kRuns);
  const int64_t begin = ptr[block_index()], count = ptr[block_index() + 1] - begin;
  const double* mean = means + begin;
  const double average = interleaved_sum(runs, count, [&](int64_t i) { return mean[i]; }) / static_cast<double>(count);
  const double spread = interleaved_sum(runs, count, [&](int64_t i) {
    const double off = mean[i] - average;
    return mean[i] > 0 ? off * off : 0.0;
  });
  // NaN for one point: every comparison is then false.
  const double threshold = average + ratio * sqrt(spread / static_cast<double>(count - 1));
  for (int64_t i = thread_in_block(); i < count; i += kRuns) outlier[begin + i] = !(mean[i] > 0 && mean[i] < threshold);
}

}  // namespace pc::gpu
