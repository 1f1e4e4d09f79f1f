// Sorting eight values in every lane at once.
#pragma once

#include "pc/neighbors/nearest.hpp"

namespace pc::neighbors {

// EightPacks values per lane. Loops over them are written out by a fold, and all is inlined: GCC keeps an array in
// registers only when its indices are constants from the start and its address is never needed.
struct EightPacks {
  FloatPack v[8];

  template <class Body>
  [[gnu::always_inline]] static EightPacks each(Body&& body) {
    return each(body, std::make_index_sequence<8>());
  }
  [[gnu::always_inline]] static EightPacks load(const float (*from)[kQueries]) {
    return each([&](size_t i) __attribute__((always_inline)) { return FloatPack::load(from[i]); });
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
  [[gnu::always_inline]] static EightPacks nearer(const EightPacks& a, const EightPacks& b) {
    return each([&](size_t i) __attribute__((always_inline)) { return minimum(a.v[i], b.v[7 - i]); });
  }
  [[gnu::always_inline]] static EightPacks farther(const EightPacks& a, const EightPacks& b) {
    return each([&](size_t i) __attribute__((always_inline)) { return maximum(a.v[i], b.v[7 - i]); });
  }

 private:
  [[gnu::always_inline]] void exchange(size_t i, size_t j) {
    const FloatPack low = minimum(v[i], v[j]);
    v[j] = maximum(v[i], v[j]);
    v[i] = low;
  }
  template <class Body, size_t... I>
  [[gnu::always_inline]] static EightPacks each(Body&& body, std::index_sequence<I...>) {
    EightPacks result;
    ((result.v[I] = body(I)), ...);
    return result;
  }
};

}  // namespace pc::neighbors
