// Bits of Morton (Z-order) codes.
//
// Source: Morton, A computer oriented geodetic data base, IBM 1966.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

// Put two zero bits between the 11 bits of a value.
PC_HD uint64_t spread_bits(uint64_t v) {
  v = (v | v << 16) & 0x70000FF;
  v = (v | v << 8) & 0x700F00F;
  v = (v | v << 4) & 0x430C30C3;
  return (v | v << 2) & 0x49249249;
}

// The code of three numbers of 11 bits, x highest.
PC_HD uint64_t morton_code(uint64_t x, uint64_t y, uint64_t z) {
  return spread_bits(x) << 2 | spread_bits(y) << 1 | spread_bits(z);
}

// Bits 0, 2, 4 and 6 of a number, moved together.
PC_HD int64_t even_bits(int64_t v) { return (v & 1) | (v >> 1 & 2) | (v >> 2 & 4) | (v >> 3 & 8); }

}  // namespace pc::math
