"""How a sensor's depth error grows with distance: two formulas cover the sensors in the catalog."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from torch import Tensor

Depth = TypeVar("Depth", float, Tensor)  # metres


@dataclass(frozen=True, kw_only=True)
class StereoNoise:
    """A constant error in disparity: ``sigma_z = z^2 * subpixel / (focal * baseline)``.

    Source: Chang & Chatterjee, Quantization Error Analysis in Stereo Vision, 1992; Keselman et al., Intel RealSense
    Stereoscopic Depth Cameras, 2017.
    """

    subpixel: float  # pixels: standard deviation of the disparity
    baseline: float  # metres between the two imagers, or imager and projector
    disparity_step: float = 0.0  # pixels: the smallest disparity difference the matcher reports, 0 = continuous

    def sigma(self, depth: Depth, focal: float) -> Depth:
        """Return the standard deviation in metres at this depth, for a focal length in pixels."""
        return depth * depth * (self.subpixel / (focal * self.baseline))

    @property
    def formula(self) -> str:
        """The formula with its numbers."""
        return f"z^2 * {self.subpixel:g} px / (focal * {self.baseline:g} m)"


@dataclass(frozen=True, kw_only=True)
class PolynomialNoise:
    """A polynomial fitted to measurements: ``sigma_z = c0 + c1 * (z - origin) + c2 * (z - origin)^2``."""

    coefficients: tuple[float, ...]  # c0, c1, ...: the result is in metres
    origin: float = 0.0  # metres

    def sigma(self, depth: Depth, focal: float) -> Depth:
        """Return the standard deviation in metres at this depth; the focal length plays no part."""
        offset = depth - self.origin
        total = offset * 0.0
        for coefficient in reversed(self.coefficients):
            total = total * offset + coefficient
        return total

    @property
    def formula(self) -> str:
        """The formula with its numbers."""
        base = f"(z - {self.origin:g})" if self.origin else "z"
        powers = ["", f" * {base}", *(f" * {base}^{power}" for power in range(2, len(self.coefficients)))]
        return " + ".join(f"{c:g}{power}" for c, power in zip(self.coefficients, powers) if c)
