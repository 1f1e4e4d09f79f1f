// The grid of a truncated signed distance field and what a view needs to be averaged into it. The layout of keys,
// blocks and planes is that of pcdata/functional/tsdf; results equal that reference bit for bit.
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
  const int64_t* chunks;                   // addresses of the plane in each chunk's first block
  int64_t stride;                          // bytes from block to block

  explicit operator bool() const { return chunks != nullptr; }
  T* block(int64_t row) const {
    return reinterpret_cast<T*>(static_cast<uintptr_t>(chunks[row / kChunk] + row % kChunk * stride));
  }
};

// The planes of a block lie behind one another.
struct VoxelPlanes {
  Plane<int16_t> tsdf, weight;
  Plane<int32_t> color;
  Plane<int16_t> views;
  Plane<int32_t> label;
  Plane<int16_t> votes;

  explicit VoxelPlanes(const int64_t* const* planes)
      : VoxelPlanes(planes, kVoxels * (4 + (planes[2] ? 4 : 0) + (planes[3] ? 2 : 0) + (planes[4] ? 4 : 0) +
                                       (planes[5] ? 2 : 0))) {}

 private:
  VoxelPlanes(const int64_t* const* planes, int64_t stride)
      : tsdf{planes[0], stride},
        weight{planes[1], stride},
        color{planes[2], stride},
        views{planes[3], stride},
        label{planes[4], stride},
        votes{planes[5], stride} {}
};

typedef int16_t ShortLanes __attribute__((vector_size(2 * kLanes)));

inline IntLanes widened(const int16_t* from) { return __builtin_convertvector(load<ShortLanes>(from), IntLanes); }
inline void store_short(int16_t* to, const IntLanes& lanes) { store(to, __builtin_convertvector(lanes, ShortLanes)); }
inline FloatLanes as_float(const IntLanes& lanes) { return __builtin_convertvector(lanes, FloatLanes); }
inline IntLanes truncated(const FloatLanes& lanes) { return __builtin_convertvector(lanes, IntLanes); }

// The greatest integer that is not above; INT32_MIN for what no int32 holds.
inline IntLanes floored(const FloatLanes& x) {
#if defined(__AVX512DQ__)
  constexpr int down = _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC;
  return reinterpret_cast<IntLanes>(_mm512_maskz_cvt_roundps_epi32(0xffff, reinterpret_cast<__m512>(x), down));
#elif defined(__AVX2__)
  return reinterpret_cast<IntLanes>(_mm256_cvtps_epi32(_mm256_floor_ps(reinterpret_cast<__m256>(x))));
#else
  const IntLanes whole = truncated(x);
  return whole + (as_float(whole) > x);  // a comparison is -1 where it holds
#endif
}

// The nearest integer, the even one of two; for values below 2^22.
inline IntLanes rounded(const FloatLanes& x) {
#if defined(__AVX512DQ__)
  return reinterpret_cast<IntLanes>(_mm512_maskz_cvtps_epi32(0xffff, reinterpret_cast<__m512>(x)));
#elif defined(__AVX2__)
  return reinterpret_cast<IntLanes>(_mm256_cvtps_epi32(reinterpret_cast<__m256>(x)));
#else
  constexpr float shift = 12582912.0f;
  return truncated((x + shift) - shift);
#endif
}

// The first `count` numbers, or as many as there are lanes; the rest is 0.
inline FloatLanes load_up_to(const float* from, int64_t count) {
  if (count >= kLanes) return load<FloatLanes>(from);
  FloatLanes lanes = {};
  std::memcpy(&lanes, from, static_cast<size_t>(count) * sizeof(float));
  return lanes;
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
