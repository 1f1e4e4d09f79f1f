// The grid of a truncated signed distance field and what a view needs to be averaged into it. The layout of keys, blocks
// and planes is that of pcdata/functional/tsdf; results equal that reference bit for bit.
#pragma once

#include <cmath>

#include "pc/lanes.hpp"

namespace pc {

constexpr int kEdge = 8, kVoxels = 512;  // of a block
constexpr int64_t kBlocksPerSide = int64_t{1} << 20;
constexpr float kTsdfScale = 32767, kMaxWeight = 32767;

struct BlockPlace {
  int64_t x, y, z;

  static BlockPlace of(int64_t key) {
    constexpr int64_t low = 2 * kBlocksPerSide - 1;
    return {(key >> 42) - kBlocksPerSide, ((key >> 21) & low) - kBlocksPerSide, (key & low) - kBlocksPerSide};
  }
  int64_t key() const {
    return ((x + kBlocksPerSide) << 42) | ((y + kBlocksPerSide) << 21) | (z + kBlocksPerSide);
  }
  bool exists() const {
    const auto inside = [](int64_t a) { return -kBlocksPerSide < a && a < kBlocksPerSide; };
    return inside(x) && inside(y) && inside(z);
  }
};

// One plane of all blocks: chunk by chunk, null where the volume has no such plane.
template <class T>
struct Plane {
  static constexpr int64_t kChunk = 8192;  // blocks
  const int64_t* chunks;                   // addresses

  explicit operator bool() const { return chunks != nullptr; }
  T* block(int64_t row) const {
    return reinterpret_cast<T*>(static_cast<uintptr_t>(chunks[row / kChunk])) + row % kChunk * kVoxels;
  }
};

struct VoxelPlanes {
  Plane<int16_t> tsdf, weight;
  Plane<int32_t> color;
  Plane<int16_t> views;
  Plane<int32_t> label;
  Plane<int16_t> votes;

  explicit VoxelPlanes(const int64_t* const* planes)
      : tsdf{planes[0]}, weight{planes[1]}, color{planes[2]}, views{planes[3]}, label{planes[4]}, votes{planes[5]} {}
};

typedef int16_t ShortLanes __attribute__((vector_size(2 * kLanes)));

inline IntLanes widened(const int16_t* from) { return __builtin_convertvector(load<ShortLanes>(from), IntLanes); }
inline void store_short(int16_t* to, const IntLanes& lanes) { store(to, __builtin_convertvector(lanes, ShortLanes)); }
inline FloatLanes as_float(const IntLanes& lanes) { return __builtin_convertvector(lanes, FloatLanes); }
inline IntLanes truncated(const FloatLanes& lanes) { return __builtin_convertvector(lanes, IntLanes); }

// To the nearest integer, the even one of two; for values below 2^22.
inline FloatLanes rounded(const FloatLanes& x) {
  constexpr float shift = 12582912.0f;
  return (x + shift) - shift;
}

inline FloatLanes gather(const float* from, const IntLanes& index) {
#if defined(__AVX512DQ__)
  return _mm512_i32gather_ps(reinterpret_cast<__m512i>(index), from, 4);
#elif defined(__AVX2__)
  return _mm256_i32gather_ps(from, reinterpret_cast<__m256i>(index), 4);
#else
  FloatLanes result;
  for (int i = 0; i < kLanes; ++i) result[i] = from[index[i]];
  return result;
#endif
}
inline IntLanes gather(const int32_t* from, const IntLanes& index) {
  return reinterpret_cast<IntLanes>(gather(reinterpret_cast<const float*>(from), index));
}

}  // namespace pc
