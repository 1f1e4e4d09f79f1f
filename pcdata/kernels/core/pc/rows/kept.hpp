// What a decision about rows leaves: which rows stay, where the clouds then begin, and a number per cloud that tells
// the rows. A kernel that decides can call mark_kept() behind it, on marks that are still in the caches.
#pragma once

#include <cstring>

#include "pc/math/random.hpp"
#include "pc/memory.hpp"
#include "pc/simd.hpp"
#include "pc/threads.hpp"

namespace pc::rows {

constexpr int64_t kRowsPerPiece = 16384;

// 64 bytes of 0 and 1 as bits, the first one lowest.
inline uint64_t bits_of(const uint8_t* flags) {
#if defined(PC_AVX512)
  const __m512i bytes = _mm512_loadu_si512(flags);
  return _mm512_test_epi8_mask(bytes, bytes);
#elif defined(__AVX2__)
  const auto half = [&](int first) {
    const __m256i bytes = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(flags + first));
    return uint64_t{static_cast<uint32_t>(_mm256_movemask_epi8(_mm256_slli_epi16(bytes, 7)))};
  };
  return half(0) | half(32) << 32;
#else
  constexpr uint64_t kOfEight = 0x0102040810204080;  // moves bit 8k to bit 56 + k, and no two to one place
  uint64_t bits = 0;
  for (int i = 0; i < 64; i += 8) {
    uint64_t eight;
    std::memcpy(&eight, flags + i, 8);
    bits |= (eight * kOfEight >> 56) << i;
  }
  return bits;
#endif
}

// The bits at the places where `chosen` has ones, moved together to the lowest places.
inline uint64_t packed_bits(uint64_t bits, uint64_t chosen) {
#if defined(__BMI2__)
  return _pext_u64(bits, chosen);
#else
  uint64_t packed = 0;
  for (int place = 0; chosen != 0; chosen &= chosen - 1, ++place)
    packed |= uint64_t{(bits & chosen & (0 - chosen)) != 0} << place;
  return packed;
#endif
}

// The number that tells a sequence of bits: see pcdata/contracts/checksums.py, which defines it.
class BitSum {
 public:
  void add(uint64_t bits, int64_t count) {  // no more than 64, the others are 0
    word_ |= bits << filled_;
    const int64_t left = 64 - filled_;
    all_ += static_cast<uint64_t>(count);
    if (count < left) {
      filled_ += count;
      return;
    }
    take();
    word_ = left == 64 ? 0 : bits >> left;
    filled_ = count - left;
  }
  int64_t value() {
    if (filled_ != 0) take();
    return static_cast<int64_t>(math::random_word(sum_, all_) >> 32);
  }

 private:
  void take() { sum_ += math::random_word(word_, number_++); }

  uint64_t word_ = 0, sum_ = 0, number_ = 0, all_ = 0;
  int64_t filled_ = 0;  // bits of the word, below 64
};

struct Kept {
  uint8_t* keep;  // (N,) 1 = the row stays
  int64_t* ptr;   // (clouds + 1,) of the rows that stay
  int64_t* sums;  // (clouds,)
};

// Keep the rows whose mark is true, or, with `gone`, is not, and among these those `within`, unless that is null. Sums
// tell which of the rows within are kept, whatever lies between them. `marks` may be the result.
inline void mark_kept(const pc_context& context, const uint8_t* marks, bool gone, const uint8_t* within,
                      const int64_t* ptr, int64_t clouds, const Kept& kept) {
  ScratchFrame scratch;
  const std::vector<CloudPiece> pieces = cut_clouds(ptr, clouds, kRowsPerPiece);
  const auto num_pieces = static_cast<int64_t>(pieces.size());
  const auto word_of = [&](int64_t begin, int64_t piece) { return begin / 64 + piece; };  // pieces do not share any
  uint64_t* words = scratch.take<uint64_t>(word_of(ptr[clouds], num_pieces) + 1);
  uint8_t* of_words = scratch.take<uint8_t>(word_of(ptr[clouds], num_pieces) + 1);  // the rows that each tells of
  int64_t* counts = scratch.take<int64_t>(num_pieces);
  for_each_piece(context, pieces, kRowsPerPiece, [&](const CloudPiece& piece, int64_t number) {
    uint8_t keep[kRowsPerPiece + 64], there[kRowsPerPiece + 64];
    const int64_t size = piece.end - piece.begin;
    const uint8_t* mark = marks + piece.begin;
    for (int64_t i = 0; i < size; ++i) keep[i] = static_cast<uint8_t>((mark[i] != 0) != gone);
    if (within != nullptr) {
      for (int64_t i = 0; i < size; ++i) there[i] = within[piece.begin + i] != 0;
      for (int64_t i = 0; i < size; ++i) keep[i] &= there[i];
      std::fill(there + size, there + size + 64, uint8_t{0});
    }
    std::memcpy(kept.keep + piece.begin, keep, static_cast<size_t>(size));
    std::fill(keep + size, keep + size + 64, uint8_t{0});
    uint64_t* word = words + word_of(piece.begin, number);
    uint8_t* of_word = of_words + word_of(piece.begin, number);
    int64_t found = 0;
    for (int64_t i = 0; i < size; i += 64) {
      uint64_t bits = bits_of(keep + i);
      found += __builtin_popcountll(bits);
      int64_t count = std::min<int64_t>(64, size - i);
      if (within != nullptr) {
        const uint64_t chosen = bits_of(there + i);
        bits = packed_bits(bits, chosen);
        count = __builtin_popcountll(chosen);
      }
      *word++ = bits;
      *of_word++ = static_cast<uint8_t>(count);
    }
    counts[number] = found;
  });
  int64_t total = 0, piece = 0;
  for (int64_t cloud = 0; cloud < clouds; ++cloud) {
    kept.ptr[cloud] = total;
    BitSum sum;
    for (; piece < num_pieces && pieces[static_cast<size_t>(piece)].cloud == cloud; ++piece) {
      const auto [own, begin, end] = pieces[static_cast<size_t>(piece)];
      const int64_t first = word_of(begin, piece);
      for (int64_t word = first; word < first + (end - begin + 63) / 64; ++word) sum.add(words[word], of_words[word]);
      total += counts[piece];
    }
    kept.sums[cloud] = sum.value();
  }
  kept.ptr[clouds] = total;
}

}  // namespace pc::rows
