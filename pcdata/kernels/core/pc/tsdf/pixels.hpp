// Two ways to look up the pixels that a block's voxels fall on. Each has Places, which number pixels, and a Table per
// image, which finds them by these numbers.
#pragma once

#include "pc/tsdf/view.hpp"

namespace pc::tsdf {

// Pixels looked up in the image, by their number.
struct ImagePixels {
  template <class T>
  class Table {
   public:
    Table(const FusedView&, const ProjectedBlock&, const T* image) : image_(image) {}
    auto at(const Int32Register& place) const { return gather(image_, place); }

   private:
    const T* image_;
  };

  class Places {
   public:
    Places(const FusedView& view, const ProjectedBlock&) : width_(Int32Register{} + static_cast<int32_t>(view.width)) {}
    Int32Register of(const Int32Register& u, const Int32Register& v) const { return v * width_ + u; }

   private:
    Int32Register width_;
  };
};

#if defined(PC_AVX512)
// Pixels of a small window, looked up by permuting registers: a gather takes as long as eight of these. Places count
// from the first pixel of the window.
template <int kEntries>
struct TablePixels {
  template <class T>
  class Table {
   public:
    Table(const FusedView& view, const ProjectedBlock& block, const T* image) {
      const T* from = image + block.v * view.width + block.u;
      for (int i = 0; i < kRegisters; ++i) {
        if (block.shift == 4) {
          rows_[i] = _mm512_loadu_si512(from);
          from += view.width;
        } else {
          const __m256i first = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(from));
          const __m256i second = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(from + view.width));
          rows_[i] = _mm512_maskz_inserti64x4(0xff, _mm512_zextsi256_si512(first), second, 1);
          from += 2 * view.width;
        }
      }
    }
    auto at(const Int32Register& place) const {
      typedef T Lanes __attribute__((vector_size(4 * kLanes)));
      return reinterpret_cast<Lanes>(find<kRegisters>(rows_, native(place)));
    }

   private:
    static constexpr int kRegisters = kEntries / kLanes;

    template <int kCount>
    static __m512i find(const __m512i* rows, __m512i place) {
      if constexpr (kCount == 2) {
        return _mm512_permutex2var_epi32(rows[0], place, rows[1]);
      } else {
        const __mmask16 second = _mm512_test_epi32_mask(place, _mm512_set1_epi32(kCount / 2 * kLanes));
        const __m512i low = find<kCount / 2>(rows, place), high = find<kCount / 2>(rows + kCount / 2, place);
        return _mm512_mask_blend_epi32(second, low, high);
      }
    }
    __m512i rows_[kRegisters];
  };

  class Places {
   public:
    Places(const FusedView&, const ProjectedBlock& block)
        : shift_(block.shift), first_(Int32Register{} + ((block.v << block.shift) + block.u)) {}
    Int32Register of(const Int32Register& u, const Int32Register& v) const { return (v << shift_) + u - first_; }

   private:
    int32_t shift_;
    Int32Register first_;
  };
};
#endif

}  // namespace pc::tsdf
