// The nearest points: their distances and which they are.
#pragma once

#include <algorithm>
#include <vector>

#include "pc/neighbors/nearest.hpp"

namespace pc::neighbors {

// A squared distance above an id in 64 bits: the total order (d2, id) as one comparison. The bits of a non-negative
// float ascend like its value; raised by kLift they are also the high word of a normal double, so the processor's
// minimum and maximum of doubles sort keys on every instruction set (integers would need AVX-512), even where it has
// been told to take denormal numbers for zero. -infinity becomes a negative double, below all distances.
class NearKey {
 public:
  static DoublePack of(const FloatPack& squared, const Ids& ids) {
    using Bits = uint32_t __attribute__((vector_size(kRegisterBytes / 2)));
    using Keys = uint64_t __attribute__((vector_size(kRegisterBytes)));
    constexpr size_t kNarrow = sizeof(Bits) / sizeof(uint32_t);
    return DoublePack::each([&](size_t p) {
      Bits bits, id;
      std::memcpy(&bits, reinterpret_cast<const float*>(&squared.part[p / 2]) + p % 2 * kNarrow, sizeof(bits));
      std::memcpy(&id, ids.lane + p * kNarrow, sizeof(id));
      const Keys high = __builtin_convertvector(bits + kLift, Keys), low = __builtin_convertvector(id, Keys);
      return reinterpret_cast<DoubleRegister>(high << 32 | low);
    });
  }
  static uint64_t of(float squared, uint32_t id) {
    uint32_t bits;
    std::memcpy(&bits, &squared, sizeof(bits));
    return uint64_t{bits + kLift} << 32 | id;
  }
  static uint32_t id(uint64_t key) { return static_cast<uint32_t>(key); }
  static float squared(uint64_t key) {
    const uint32_t bits = static_cast<uint32_t>(key >> 32) - kLift;
    float value;
    std::memcpy(&value, &bits, sizeof(value));
    return value;
  }
  static FloatPack squared(const DoublePack& keys) {
    alignas(64) uint64_t key[kQueries];
    alignas(64) float value[kQueries];
    std::memcpy(key, &keys, sizeof(key));
    for (int lane = 0; lane < kQueries; ++lane) value[lane] = squared(key[lane]);
    return FloatPack::load(value);
  }

 private:
  static constexpr uint32_t kLift = 0x00100000;  // the lowest exponent bit of a double's high word
};

// The k nearest candidates, ascending by (squared distance, id). Empty places have id kNoId.
class NearestKeys {
 public:
  static constexpr int kMax = 48;

  void start(int k, const FloatPack& limit) {
    size_ = (k + 3) / 4 * 4;
    first_ = size_ - k;
    const DoublePack off = NearKey::of(FloatPack(kOff), Ids::same(0)), empty = NearKey::of(limit, Ids::same(kNoId));
    for (int i = -1; i < size_; ++i) set(i, i < first_ ? off : empty);
    bound_ = limit;
  }
  const FloatPack& bound() const { return bound_; }
  float widest() const { return largest(bound_); }
  PackMask wants(const FloatPack& squared) const { return less_equal(squared, bound_); }

  void offer(const FloatPack& squared, const Ids& ids) {
    const DoublePack key = NearKey::of(squared, ids);
    DoublePack here = get(size_ - 1);
    for (int i = size_ - 4; i >= 0; i -= 4) {
      const DoublePack c = get(i + 2), b = get(i + 1), a = get(i), before = get(i - 1);
      set(i + 3, minimum(here, maximum(c, key)));
      set(i + 2, minimum(c, maximum(b, key)));
      set(i + 1, minimum(b, maximum(a, key)));
      set(i, minimum(a, maximum(before, key)));
      if (!less(key, before)) break;
      here = before;
    }
    bound_ = NearKey::squared(get(size_ - 1));
  }
  void settle() {}
  void finish() {}
  uint64_t key(int i, int lane) const {
    uint64_t key;
    std::memcpy(&key, &slot_[first_ + i + 1][lane], sizeof(key));
    return key;
  }

 private:
  DoublePack get(int i) const { return DoublePack::load(slot_[i + 1]); }
  void set(int i, const DoublePack& value) { value.store(slot_[i + 1]); }

  alignas(64) double slot_[kMax + 1][kQueries];
  FloatPack bound_;
  int size_, first_;
};

// The same for any k: candidates pile up to twice k, then the nearer half is selected and sets the bound.
class NearestMany {
 public:
  void start(int k, const FloatPack& limit) {
    k_ = static_cast<size_t>(k);
    limit.store(bound_lane_);
    for (auto& pile : pile_) pile.clear();
    bound_ = limit;
  }
  const FloatPack& bound() const { return bound_; }
  float widest() const { return largest(bound_); }
  PackMask wants(const FloatPack& squared) const { return less_equal(squared, bound_); }

  void offer(const FloatPack& squared, const Ids& ids) {
    alignas(64) float value[kQueries];
    squared.store(value);
    bool full = false;
    for (PackMask left = wants(squared); left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      pile_[lane].push_back(NearKey::of(value[lane], ids.lane[lane]));
      full |= pile_[lane].size() >= 2 * k_ + kSlack;
    }
    if (full) shrink();
  }
  void settle() {}
  void finish() {
    shrink();
    for (auto& pile : pile_) std::sort(pile.begin(), pile.end());
  }
  uint64_t key(int i, int lane) const {
    const size_t at = static_cast<size_t>(i);
    return at < pile_[lane].size() ? pile_[lane][at] : NearKey::of(kInfinity, kNoId);
  }
  FloatPack squared(int i) const {
    alignas(64) float value[kQueries];
    for (int lane = 0; lane < kQueries; ++lane) value[lane] = NearKey::squared(key(i, lane));
    return FloatPack::load(value);
  }

 private:
  static constexpr size_t kSlack = 64;

  void shrink() {
    for (int lane = 0; lane < kQueries; ++lane) {
      auto& pile = pile_[lane];
      if (pile.size() < k_) continue;
      std::nth_element(pile.begin(), pile.begin() + static_cast<ptrdiff_t>(k_ - 1), pile.end());
      pile.resize(k_);
      bound_lane_[lane] = NearKey::squared(pile[k_ - 1]);
    }
    bound_ = FloatPack::load(bound_lane_);
  }

  size_t k_ = 0;
  std::vector<uint64_t> pile_[kQueries];
  alignas(64) float bound_lane_[kQueries];
  FloatPack bound_;
};

}  // namespace pc::neighbors
