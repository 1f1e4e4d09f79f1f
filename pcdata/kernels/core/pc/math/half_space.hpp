// Half-spaces through a camera that hold all points from some column or row of its image on.
#pragma once

#include "pc/math/host_device.hpp"

namespace pc::math {

// All points beyond the plane coordinate = slope * z: a query there is b z - a coordinate away from those above the
// slope, a coordinate - b z from those below. With an infinite slope, that of no point, the distance is infinite.
struct HalfSpace {
  float a, b;

  PC_HD static HalfSpace of(float slope) {
    const bool nothing = slope * 0 != 0;
    const double length = sqrt(1.0 + static_cast<double>(slope) * static_cast<double>(slope));
    return {nothing ? 0.0F : static_cast<float>(1.0 / length),
            nothing ? slope : static_cast<float>(static_cast<double>(slope) / length)};
  }
};

constexpr float kLeastDepth = 1e-30F, kMostSlope = 1e18F;  // so that no slope overflows

// How far rounding may have moved a distance to a plane: a dozen roundings at most, each of half a unit in the 24th bit
// of the largest coordinate.
PC_HD float rounding_slack(float x, float y, float z) { return (fabsf(x) + fabsf(y) + z) * 1e-6F; }

// Less a margin for rounding of computed squared distances (4e-7) and motions that are rigid only to 1e-5.
PC_HD float squared_clearance(float side) {
  const float clear = side > 0 ? side : 0.0F;
  return clear * clear * (1.0F - 1e-4F);
}

}  // namespace pc::math
