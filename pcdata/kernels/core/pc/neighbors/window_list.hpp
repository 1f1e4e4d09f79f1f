// The least of the distances to pixels around sixteen queries.
#pragma once

#include "pc/neighbors/sorted_columns.hpp"

namespace pc::neighbors {

// The smallest squared distances to pixels around sixteen queries, the queries themselves left out.
//
// A list per lane holds `wanted` numbers in whole blocks of rows, those before them -infinity. What is least of two
// ascending lists is least of the pairs of one's first with the other's last, its second with the other's last but one,
// ...; that rises and then falls, and is sorted again only when more follows.
//
// As many distances as the list holds are worked out, sorted and merged without leaving the registers: hence the number
// of blocks is known when this is compiled, and distances are asked for as body(i, lane), a register from a lane on.
// What does so stays a function of its own: inlined, GCC gives it too few registers.
template <int kBlocks>
class WindowList {
 public:
  static constexpr int kSize = kBlocks * kBlockRows;

  explicit WindowList(int wanted) : wanted_(wanted) {
    for (int i = 0; i < before(); ++i) FloatPack(-kInfinity).store(list_[i]);
  }

  // Begin with body(0), ... body(kSize - 1).
  template <class Body>
  [[gnu::noinline]] void start(const Body& body) {
    for_registers([&](int lane) __attribute__((always_inline)) {
      Sorted sorted(body, 0, lane);
      sorted.store(list_ + before(), lane);
    });
    bound_ = FloatPack::load(list_[kSize - 1]);
    is_sorted_ = true;
  }

  // Take body(first), ... body(last - 1), whole blocks.
  template <class Body>
  [[gnu::noinline]] void take(int first, int last, const Body& body) {
    for (; last - first >= kSize; first += kSize) {
      sort_list();
      for_registers([&](int lane) __attribute__((always_inline)) {
        Sorted sorted(body, first, lane);
        store(&bound_.part[lane / kLanes], sorted.merge(list_, lane));
      });
      is_sorted_ = false;
    }
    if (first == last) return;
    for (int i = first; i < last; ++i) each(body, i).store(taken_[i - first]);
    merge_taken((last - first) / kBlockRows);
  }

  // The same where few are less than the bound: only those that are so in any lane are sorted.
  template <class Body>
  [[gnu::noinline]] void take_few(int first, int last, const Body body) {
    for (int some; first < last; first += some) {
      some = std::min(last - first, 64);
      const FloatPack bound = bound_;
      uint64_t chosen = 0;
      for (int i = 0; i < some; ++i) chosen |= uint64_t{any_less(each(body, first + i), bound)} << i;
      while (chosen != 0) {
        int index[kBlockRows];
        float floor[kBlockRows];
        for (int i = 0; i < kBlockRows; ++i) {
          index[i] = chosen != 0 ? first + __builtin_ctzll(chosen) : first;
          floor[i] = chosen != 0 ? 0 : kInfinity;
          chosen &= chosen - 1;
        }
        take_block(body, index, floor);
      }
    }
  }

  // The largest that is wanted, and the least.
  const FloatPack& bound() const { return bound_; }
  FloatPack least() const { return minimum(FloatPack::load(list_[before()]), FloatPack::load(list_[kSize - 1])); }
  // (wanted, 16), which rise or rise and then fall.
  const Row* squared() const { return list_ + before(); }

 private:
  template <int>
  friend class WindowList;

  // One register of each of kSize distances, ascending.
  struct Sorted {
    FloatRegister v[kSize];

    template <class Body>
    [[gnu::always_inline]] Sorted(const Body& body, int first, int lane)
        : Sorted(body, first, lane, std::make_index_sequence<kSize>()) {}
    template <class Body, size_t... I>
    [[gnu::always_inline]] Sorted(const Body& body, int first, int lane, std::index_sequence<I...>)
        : v{body(first + static_cast<int>(I), lane)...} {
      NetworkOf<Network::kSorting, kSize>::exchange(v);
    }
    [[gnu::always_inline]] void store(Row* to, int lane) const { store(to, lane, std::make_index_sequence<kSize>()); }
    template <size_t... I>
    [[gnu::always_inline]] void store(Row* to, int lane, std::index_sequence<I...>) const {
      (pc::store(to[I] + lane, v[I]), ...);
    }
    // Leave what is less of the pairs in the list, and return the largest of that.
    [[gnu::always_inline]] FloatRegister merge(Row* list, int lane) {
      return merge(list, lane, std::make_index_sequence<kSize>());
    }
    template <size_t... I>
    [[gnu::always_inline]] FloatRegister merge(Row* list, int lane, std::index_sequence<I...>) {
      FloatRegister most = FloatRegister{} - kInfinity;
      ((v[I] = minimum(v[I], load<FloatRegister>(list[kSize - 1 - I] + lane)), most = maximum(v[I], most),
        pc::store(list[kSize - 1 - I] + lane, v[I])),
       ...);
      return most;
    }
  };

  int before() const { return kSize - wanted_; }

  template <class Body>
  [[gnu::always_inline]] static void for_registers(Body&& body) {
    for (int lane = 0; lane < kQueries; lane += kLanes) body(lane);
  }
  template <class Body>
  [[gnu::always_inline]] static FloatPack each(const Body& body, int i) {
    return FloatPack::each([&](size_t p) { return body(i, static_cast<int>(p) * kLanes); });
  }

  void sort_list() {
    if (!is_sorted_) NetworkOf<Network::kMerging, kSize>::run(list_);
    is_sorted_ = true;
  }

  // Take a block of distances, where they are not less than the floor.
  template <class Body>
  [[gnu::always_inline]] void take_block(const Body& body, const int* index, const float* floor) {
    sort_list();
    for_registers([&](int lane) __attribute__((always_inline)) {
      const auto at_least_floor = [&](int i, int own_lane) __attribute__((always_inline)) {
        return maximum(body(index[i], own_lane), floor[i] - FloatRegister{});
      };
      typename WindowList<1>::Sorted sorted(at_least_floor, 0, lane);
      FloatRegister most = sorted.merge(list_ + kSize - kBlockRows, lane);
      if constexpr (kBlocks > 1) most = maximum(most, load<FloatRegister>(list_[kSize - kBlockRows - 1] + lane));
      store(&bound_.part[lane / kLanes], most);
    });
    is_sorted_ = false;
  }

  [[gnu::noinline]] void merge_taken(int blocks) {
    const int count = std::min(blocks * kBlockRows, wanted_);
    sort_columns(taken_, blocks);
    sort_list();
    FloatPack most = count < wanted_ ? FloatPack::load(list_[kSize - 1 - count]) : FloatPack(-kInfinity);
    for (int i = 0; i < count; ++i) {
      Row& own = list_[kSize - 1 - i];
      const FloatPack lesser = minimum(FloatPack::load(own), FloatPack::load(taken_[i]));
      lesser.store(own);
      most = maximum(lesser, most);
    }
    bound_ = most;
    is_sorted_ = false;
  }

  alignas(64) Row list_[kSize + kBlockRows];  // the first chunk may stand up to seven rows later
  alignas(64) Row taken_[kSize];
  FloatPack bound_{kInfinity};
  int wanted_;
  bool is_sorted_ = true;
};

}  // namespace pc::neighbors
