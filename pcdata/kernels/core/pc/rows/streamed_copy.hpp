// Copies of much memory that the processor's caches are not to keep.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>

#include "pc/simd.hpp"

namespace pc::rows {

constexpr size_t kLine = 64;  // bytes: a line of the processor's cache

// Write a register past the caches: the line is not read first, and what the caches hold stays there. `to` is a
// multiple of the register's size.
inline void store_past_caches(char* to, const Int32Register& lanes) {
#if defined(PC_AVX512)
  _mm512_stream_si512(reinterpret_cast<__m512i*>(to), (__m512i)lanes);
#elif defined(__AVX2__)
  _mm256_stream_si256(reinterpret_cast<__m256i*>(to), (__m256i)lanes);
#elif defined(__SSE2__)
  _mm_stream_si128(reinterpret_cast<__m128i*>(to), (__m128i)lanes);
#else
  store(to, lanes);
#endif
}

// What was written past the caches becomes visible before what is written from here on.
inline void end_streamed() {
#if defined(__SSE2__)
  _mm_sfence();
#endif
}

// Copy a block past the caches; end_streamed() follows the last one. Four parts of it are read side by side: the memory
// then works on several pages at once, which one loop from end to end does not make it do.
inline void copy_streamed(char* to, const char* from, size_t size) {
  constexpr size_t kParts = 4;
  const size_t head = (kLine - reinterpret_cast<uintptr_t>(to) % kLine) % kLine;
  if (size < head + kParts * 4 * kLine) {
    std::memcpy(to, from, size);
    return;
  }
  std::memcpy(to, from, head);
  to += head;
  from += head;
  size -= head;
  const size_t part = size / kParts / kLine * kLine;
  constexpr size_t kRegisters = kLine / kRegisterBytes;
  for (size_t at = 0; at < part; at += kLine) {
    Int32Register lanes[kParts][kRegisters];
    for (size_t p = 0; p < kParts; ++p)
      for (size_t r = 0; r < kRegisters; ++r)
        lanes[p][r] = load<Int32Register>(from + p * part + at + r * kRegisterBytes);
    for (size_t p = 0; p < kParts; ++p)
      for (size_t r = 0; r < kRegisters; ++r) store_past_caches(to + p * part + at + r * kRegisterBytes, lanes[p][r]);
  }
  std::memcpy(to + kParts * part, from + kParts * part, size - kParts * part);
}

}  // namespace pc::rows
