// What a search has found so far for sixteen queries at once, one per lane.
//
// A search offers candidates one after another to all lanes; each lane keeps the nearest. All kinds share a contract:
//   start(k, limit)      lane l will keep the k nearest with d2 <= limit[l]; a limit of -infinity switches a lane off
//   wants(squared)       the lanes that this candidate could change
//   offer(squared, ids)  take a candidate: its squared distance to every lane's query, its id for every lane
//   settle()             bound() may lag behind the last offers; now it does not
//   bound(), widest()    no candidate farther than this changes the lane; any lane
//   finish()             call once at the end; then bound() is the k-th squared distance, or the limit
#pragma once

#include <algorithm>
#include <limits>

#include "pc/common.hpp"
#include "pc/sixteen.hpp"

namespace pc {

// Queries searched at once, one per lane.
constexpr int kQueries = Floats::kLanes;
constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr float kOff = -kInfinity;

// Candidate ids per lane.
struct Ids {
  alignas(64) uint32_t lane[kQueries];

  static Ids same(uint32_t id) {
    Ids ids;
    for (uint32_t& lane : ids.lane) lane = id;
    return ids;
  }
  static Ids ascending(uint32_t first) {
    Ids ids;
    for (int i = 0; i < kQueries; ++i) ids.lane[i] = first + static_cast<uint32_t>(i);
    return ids;
  }
};

constexpr uint32_t kNoId = ~uint32_t{0};

// Eight values per lane. Loops over them are written out by a fold, and all is inlined: GCC keeps an array in registers
// only when its indices are constants from the start and its address is never needed.
struct Eight {
  Floats v[8];

  template <class Body>
  [[gnu::always_inline]] static Eight each(Body&& body) {
    return each(body, std::make_index_sequence<8>());
  }
  [[gnu::always_inline]] static Eight load(const float (*from)[kQueries]) {
    return each([&](size_t i) __attribute__((always_inline)) { return Floats::load(from[i]); });
  }
  [[gnu::always_inline]] void store(float (*to)[kQueries]) const {
    v[0].store(to[0]), v[1].store(to[1]), v[2].store(to[2]), v[3].store(to[3]);
    v[4].store(to[4]), v[5].store(to[5]), v[6].store(to[6]), v[7].store(to[7]);
  }

  // Ascending: the network of 19 exchanges (Knuth, TAOCP volume 3, section 5.3.4).
  [[gnu::always_inline]] void sort() {
    exchange(0, 2), exchange(1, 3), exchange(4, 6), exchange(5, 7);
    exchange(0, 4), exchange(1, 5), exchange(2, 6), exchange(3, 7);
    exchange(0, 1), exchange(2, 3), exchange(4, 5), exchange(6, 7);
    exchange(2, 4), exchange(3, 5);
    exchange(1, 4), exchange(3, 6);
    exchange(1, 2), exchange(3, 4), exchange(5, 6);
  }
  // The same for values that fall and rise once (Batcher, Sorting networks and their applications, 1968).
  [[gnu::always_inline]] void sort_bitonic() {
    exchange(0, 4), exchange(1, 5), exchange(2, 6), exchange(3, 7);
    exchange(0, 2), exchange(1, 3), exchange(4, 6), exchange(5, 7);
    exchange(0, 1), exchange(2, 3), exchange(4, 5), exchange(6, 7);
  }
  // Of two ascending eights the nearer eight values, and the farther eight, both bitonic.
  [[gnu::always_inline]] static Eight nearer(const Eight& a, const Eight& b) {
    return each([&](size_t i) __attribute__((always_inline)) { return minimum(a.v[i], b.v[7 - i]); });
  }
  [[gnu::always_inline]] static Eight farther(const Eight& a, const Eight& b) {
    return each([&](size_t i) __attribute__((always_inline)) { return maximum(a.v[i], b.v[7 - i]); });
  }

 private:
  [[gnu::always_inline]] void exchange(size_t i, size_t j) {
    const Floats low = minimum(v[i], v[j]);
    v[j] = maximum(v[i], v[j]);
    v[i] = low;
  }
  template <class Body, size_t... I>
  [[gnu::always_inline]] static Eight each(Body&& body, std::index_sequence<I...>) {
    Eight result;
    ((result.v[I] = body(I)), ...);
    return result;
  }
};

// The k smallest squared distances, ascending, without knowing whose they are. Empty places hold the limit.
//
// start() may be given limits that the caller knows to be the k-th smallest of some of the candidates: then places that
// still hold the limit at the end hold the right value.
//
// Offers wait until there are eight, which a network sorts and merges into the sorted blocks of eight: half the
// exchanges that inserting one at a time takes.
class NearestDistances {
 public:
  static constexpr int kMax = 48;

  void start(int k, const Floats& limit) {
    k_ = k;
    blocks_ = (k + kBlock - 1) / kBlock;
    filled_ = waiting_ = 0;
    limit_ = bound_ = limit;
  }
  const Floats& bound() const { return bound_; }
  float widest() const { return largest(bound_); }
  LaneMask wants(const Floats& squared) const { return less(squared, bound_); }

  void offer(const Floats& squared, const Ids&) {
    minimum(squared, limit_).store(waiting_value_[waiting_]);
    if (++waiting_ == kBlock) merge();
  }
  void settle() {
    if (waiting_ == 0) return;
    // Places too many are filled as if they were empty.
    while (waiting_ < kBlock) limit_.store(waiting_value_[waiting_++]);
    merge();
  }
  void finish() {
    settle();
    for (; filled_ < blocks_; ++filled_)
      for (int i = 0; i < kBlock; ++i) limit_.store(value_[filled_ * kBlock + i]);
    bound_ = squared(k_ - 1);
  }
  // The i-th smallest, 0 <= i < k.
  Floats squared(int i) const { return Floats::load(value_[i]); }

 private:
  static constexpr int kBlock = 8;

  void merge() {
    Eight carried = Eight::load(waiting_value_);
    waiting_ = 0;
    carried.sort();
    int block = filled_;
    if (filled_ < blocks_) {
      ++filled_;
    } else {
      // Of the last block and the newcomers the farthest eight leave.
      --block;
      carried = Eight::nearer(Eight::load(at(block)), carried);
      carried.sort_bitonic();
    }
    // Down through the blocks: the farther eight of a block and of what is carried stay one place above it.
    for (; block > 0; --block) {
      const Eight below = Eight::load(at(block - 1));
      if (less(carried.v[0], below.v[7]) == 0) break;
      Eight stays = Eight::farther(below, carried);
      stays.sort_bitonic();
      stays.store(at(block));
      carried = Eight::nearer(below, carried);
      carried.sort_bitonic();
    }
    carried.store(at(block));
    if (filled_ == blocks_) bound_ = squared(k_ - 1);
  }

  float (*at(int block))[kQueries] { return value_ + block * kBlock; }

  alignas(64) float value_[kMax][kQueries];  // the first `filled_` blocks, ascending per lane
  alignas(64) float waiting_value_[kBlock][kQueries];
  Floats limit_, bound_;
  int k_, blocks_, filled_, waiting_;
};

// A squared distance above an id in 64 bits: the total order (d2, id) as one comparison. The bits of a non-negative
// float ascend like its value; raised by kLift they are also the high word of a normal double, so the processor's
// minimum and maximum of doubles sort keys on every instruction set (integers would need AVX-512), even where it has
// been told to take denormal numbers for zero. -infinity becomes a negative double, below all distances.
class NearKey {
 public:
  static Doubles of(const Floats& squared, const Ids& ids) {
    using Bits = uint32_t __attribute__((vector_size(kRegisterBytes / 2)));
    using Keys = uint64_t __attribute__((vector_size(kRegisterBytes)));
    constexpr size_t kNarrow = sizeof(Bits) / sizeof(uint32_t);
    return Doubles::each([&](size_t p) {
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
  static Floats squared(const Doubles& keys) {
    alignas(64) uint64_t key[kQueries];
    alignas(64) float value[kQueries];
    std::memcpy(key, &keys, sizeof(key));
    for (int lane = 0; lane < kQueries; ++lane) value[lane] = squared(key[lane]);
    return Floats::load(value);
  }

 private:
  static constexpr uint32_t kLift = 0x00100000;  // the lowest exponent bit of a double's high word
};

// The k nearest candidates, ascending by (squared distance, id). Empty places have id kNoId.
class NearestKeys {
 public:
  static constexpr int kMax = 48;

  void start(int k, const Floats& limit) {
    size_ = (k + 3) / 4 * 4;
    first_ = size_ - k;
    const Doubles off = NearKey::of(Floats(kOff), Ids::same(0)), empty = NearKey::of(limit, Ids::same(kNoId));
    for (int i = -1; i < size_; ++i) set(i, i < first_ ? off : empty);
    bound_ = limit;
  }
  const Floats& bound() const { return bound_; }
  float widest() const { return largest(bound_); }
  LaneMask wants(const Floats& squared) const { return less_equal(squared, bound_); }

  void offer(const Floats& squared, const Ids& ids) {
    const Doubles key = NearKey::of(squared, ids);
    Doubles here = get(size_ - 1);
    for (int i = size_ - 4; i >= 0; i -= 4) {
      const Doubles c = get(i + 2), b = get(i + 1), a = get(i), before = get(i - 1);
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
  Doubles get(int i) const { return Doubles::load(slot_[i + 1]); }
  void set(int i, const Doubles& value) { value.store(slot_[i + 1]); }

  alignas(64) double slot_[kMax + 1][kQueries];
  Floats bound_;
  int size_, first_;
};

// The same for any k: candidates pile up to twice k, then the nearer half is selected and sets the bound.
class NearestMany {
 public:
  void start(int k, const Floats& limit) {
    k_ = static_cast<size_t>(k);
    limit.store(bound_lane_);
    for (auto& pile : pile_) pile.clear();
    bound_ = limit;
  }
  const Floats& bound() const { return bound_; }
  float widest() const { return largest(bound_); }
  LaneMask wants(const Floats& squared) const { return less_equal(squared, bound_); }

  void offer(const Floats& squared, const Ids& ids) {
    alignas(64) float value[kQueries];
    squared.store(value);
    bool full = false;
    for (LaneMask left = wants(squared); left != 0; left &= left - 1) {
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
  Floats squared(int i) const {
    alignas(64) float value[kQueries];
    for (int lane = 0; lane < kQueries; ++lane) value[lane] = NearKey::squared(key(i, lane));
    return Floats::load(value);
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
    bound_ = Floats::load(bound_lane_);
  }

  size_t k_ = 0;
  std::vector<uint64_t> pile_[kQueries];
  alignas(64) float bound_lane_[kQueries];
  Floats bound_;
};

}  // namespace pc
