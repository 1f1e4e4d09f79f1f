// What a kernel of a GPU says about itself and its threads, in words that two compilers understand: NVRTC makes kernels
// of CUDA, any other compiler functions that the harness (harness/threads.hpp) runs thread by thread on the processor.
//
// PC_KERNEL: threads that know nothing of one another, but for atomics.
// PC_BLOCK_KERNEL: threads of a block meet at sync_block() and share what PC_SHARED declares; those of a warp talk.
// PC_GRID_KERNEL: all threads meet at sync_grid(); the launcher keeps all blocks resident.
//
// Arguments are pointers, int64_t or double, as those of the core's functions. Where threads meet, all of them must:
// none has returned, none stands at another meeting.
#pragma once

#include "pc/math/host_device.hpp"

#define PC_WARP 32

#if defined(__CUDACC__)

#define PC_KERNEL(name, ...) extern "C" __global__ void name(__VA_ARGS__)
#define PC_BLOCK_KERNEL(name, ...) PC_KERNEL(name, __VA_ARGS__)
#define PC_GRID_KERNEL(name, ...) PC_KERNEL(name, __VA_ARGS__)
#define PC_SHARED(type, name, count) __shared__ type name[count]

namespace pc::gpu {

PC_HD int thread_in_block() { return static_cast<int>(threadIdx.x); }
PC_HD int block_size() { return static_cast<int>(blockDim.x); }
PC_HD int64_t block_index() { return blockIdx.x; }
PC_HD int64_t block_count() { return gridDim.x; }

PC_HD void sync_block() { __syncthreads(); }

// Meet all threads of the grid; `arrivals` (1,) starts as 0 and counts blocks for good.
PC_HD void sync_grid(uint32_t* arrivals) {
  __syncthreads();
  if (threadIdx.x == 0) {
    __threadfence();
    const uint32_t ticket = atomicAdd(arrivals, 1u), all = gridDim.x, goal = ticket - ticket % all + all;
    while (static_cast<int>(*static_cast<volatile uint32_t*>(arrivals) - goal) < 0) {}
    __threadfence();
  }
  __syncthreads();
}

// Of a whole warp: every lane calls.
PC_HD uint32_t ballot(bool value) { return __ballot_sync(0xFFFFFFFFu, value); }
template <class T>
PC_HD T from_lane(T value, int lane) {
  return __shfl_sync(0xFFFFFFFFu, value, lane);
}
PC_HD void sync_warp() { __syncwarp(); }

PC_HD int32_t atomic_add(int32_t* place, int32_t value) { return atomicAdd(place, value); }
PC_HD int64_t atomic_add(int64_t* place, int64_t value) {
  return static_cast<int64_t>(atomicAdd(reinterpret_cast<unsigned long long*>(place), static_cast<uint64_t>(value)));
}
PC_HD int32_t atomic_min(int32_t* place, int32_t value) { return atomicMin(place, value); }
PC_HD uint64_t atomic_min(uint64_t* place, uint64_t value) { return atomicMin(place, value); }
PC_HD int32_t atomic_max(int32_t* place, int32_t value) { return atomicMax(place, value); }
PC_HD uint64_t atomic_max(uint64_t* place, uint64_t value) { return atomicMax(place, value); }
PC_HD int32_t atomic_swap_if(int32_t* place, int32_t expected, int32_t value) {
  return atomicCAS(place, expected, value);
}
PC_HD uint64_t atomic_swap_if(uint64_t* place, uint64_t expected, uint64_t value) {
  return atomicCAS(place, expected, value);
}
// What other threads wrote meanwhile, never a copy that this one has kept.
template <class T>
PC_HD T fresh(const T* place) {
  return *static_cast<const volatile T*>(place);
}

PC_HD int lowest_bit(uint32_t bits) { return __ffs(static_cast<int>(bits)) - 1; }
PC_HD int count_bits(uint32_t bits) { return __popc(bits); }
PC_HD uint32_t bits_of(float value) { return __float_as_uint(value); }
PC_HD float float_of(uint32_t bits) { return __uint_as_float(bits); }

}  // namespace pc::gpu

#else
#include "harness/threads.hpp"
#endif

namespace pc::gpu {

PC_HD int64_t thread_index() { return block_index() * block_size() + thread_in_block(); }
PC_HD int64_t thread_count() { return block_count() * block_size(); }
PC_HD int lane() { return thread_in_block() % PC_WARP; }

// The least of a warp's values, in every lane.
template <class T>
PC_HD T warp_min(T value) {
  for (int step = PC_WARP / 2; step > 0; step /= 2) {
    const T other = from_lane(value, lane() ^ step);
    value = other < value ? other : value;
  }
  return value;
}

template <class T>
PC_HD T warp_max(T value) {
  for (int step = PC_WARP / 2; step > 0; step /= 2) {
    const T other = from_lane(value, lane() ^ step);
    value = value < other ? other : value;
  }
  return value;
}

}  // namespace pc::gpu
