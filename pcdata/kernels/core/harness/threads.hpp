// A grid of threads on the processor, one after another: what pc/gpu/thread.hpp says for CUDA, here for tests.
//
// A kernel whose threads meet runs as fibers, one per thread, that change places only where they meet. Between two
// meetings each thread runs through, and which is next is drawn: a kernel that forgets to meet, or reads what another
// thread has yet to write, gives wrong results or is told of. Shared memory starts as garbage.
#pragma once

#include <cstdint>
#include <cstring>
#include <utility>

#include "pc/math/host_device.hpp"

namespace pc::harness {

enum class Meets { kNever, kInBlocks, kInGrid };

struct Here {
  int thread = 0, block_size = 1;
  int64_t block = 0, blocks = 1;
  int calls = 0;  // of the warp's exchanges so far
};

extern Here* here;

// Stand still until all others of the block, warp or grid stand here too.
void meet_block();
void meet_warp();
void meet_grid();
// The memory that the block at work shares under a name: `bytes`, the same for every thread.
void* shared(const void* name, int64_t bytes);
// Eight bytes of each lane of the warp, in two tables that take turns.
uint64_t* exchange(int table);

using Run = void (*)(const uint64_t* arguments);

// Put a kernel into the list of kernels.
bool list(const char* name, Run run, int arguments, Meets meets);

template <class T>
T argument(uint64_t bits) {
  static_assert(sizeof(T) == 8, "arguments are pointers, int64_t or double");
  T value;
  std::memcpy(&value, &bits, 8);
  return value;
}

template <class... Arguments, std::size_t... Places>
void call(void (*kernel)(Arguments...), const uint64_t* values, std::index_sequence<Places...>) {
  kernel(argument<Arguments>(values[Places])...);
}

template <class... Arguments>
constexpr int count(void (*)(Arguments...)) {
  return sizeof...(Arguments);
}

template <auto Kernel>
void run(const uint64_t* values) {
  call(Kernel, values, std::make_index_sequence<count(Kernel)>());
}

}  // namespace pc::harness

#define PC_LISTED(meets, name, ...)                                                                             \
  void name(__VA_ARGS__);                                                                                       \
  static const bool name##_is_listed =                                                                          \
      pc::harness::list(#name, &pc::harness::run<&name>, pc::harness::count(&name), pc::harness::Meets::meets); \
  void name(__VA_ARGS__)
#define PC_KERNEL(name, ...) PC_LISTED(kNever, name, __VA_ARGS__)
#define PC_BLOCK_KERNEL(name, ...) PC_LISTED(kInBlocks, name, __VA_ARGS__)
#define PC_GRID_KERNEL(name, ...) PC_LISTED(kInGrid, name, __VA_ARGS__)
#define PC_SHARED(type, name, count) \
  static const char name##_name = 0; \
  type* const name = static_cast<type*>(pc::harness::shared(&name##_name, sizeof(type) * (count)))

namespace pc::gpu {

inline int thread_in_block() { return harness::here->thread; }
inline int block_size() { return harness::here->block_size; }
inline int64_t block_index() { return harness::here->block; }
inline int64_t block_count() { return harness::here->blocks; }

inline void sync_block() { harness::meet_block(); }
inline void sync_warp() { harness::meet_warp(); }
inline void sync_grid(uint32_t* arrivals) {
  if (harness::here->thread == 0) ++*arrivals;
  harness::meet_grid();
}

template <class T>
T from_lane(T value, int lane) {
  static_assert(sizeof(T) <= 8);
  uint64_t* table = harness::exchange(harness::here->calls++ % 2);
  std::memcpy(table + harness::here->thread % 32, &value, sizeof(T));
  harness::meet_warp();
  std::memcpy(&value, table + lane, sizeof(T));
  return value;
}

inline uint32_t ballot(bool value) {
  uint64_t* table = harness::exchange(harness::here->calls++ % 2);
  table[harness::here->thread % 32] = value;
  harness::meet_warp();
  uint32_t bits = 0;
  for (int lane = 0; lane < 32; ++lane) bits |= static_cast<uint32_t>(table[lane] & 1) << lane;
  return bits;
}

// One thread runs at a time: plain operations are atomic.
template <class T>
T atomic_add(T* place, T value) {
  const T before = *place;
  *place = before + value;
  return before;
}
template <class T>
T atomic_min(T* place, T value) {
  const T before = *place;
  if (value < before) *place = value;
  return before;
}
template <class T>
T atomic_max(T* place, T value) {
  const T before = *place;
  if (before < value) *place = value;
  return before;
}
template <class T>
T atomic_swap_if(T* place, T expected, T value) {
  const T before = *place;
  if (before == expected) *place = value;
  return before;
}
template <class T>
T fresh(const T* place) {
  return *place;
}

inline int lowest_bit(uint32_t bits) { return __builtin_ctz(bits); }
inline int count_bits(uint32_t bits) { return __builtin_popcount(bits); }
inline uint32_t bits_of(float value) {
  uint32_t bits;
  std::memcpy(&bits, &value, 4);
  return bits;
}
inline float float_of(uint32_t bits) {
  float value;
  std::memcpy(&value, &bits, 4);
  return value;
}

}  // namespace pc::gpu
