"""Depth in a few whole numbers, spaced evenly or in their logarithm between two depths, as videos of depth have it.

Source: LeRobot, ``depth_utils.py`` and ``configs/video.py`` (0.6), after BEHAVIOR-1K.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import UnitError

CODES = 1 << 12
_ROUNDED = 0.502  # codes: half of one, and what logarithms of float32 millimetres add to that


@dataclass(frozen=True)
class QuantizedDepth:
    """12-bit codes: 0 is ``near``, 4095 is ``far``; what lies beyond either was clipped to it, "no reading" too.

    Args:
        near: metres.
        far: metres.
        shift: metres added before the logarithm.
        is_log: the codes are spaced evenly in log(depth + shift), else in depth.

    Raises:
        UnitError: they are no range of depths.
    """

    near: float = 0.01
    far: float = 10.0
    shift: float = 3.5
    is_log: bool = True

    def __post_init__(self) -> None:
        ends = (self.near, self.far, self.shift)
        if not (all(map(math.isfinite, ends)) and 0 <= self.near < self.far <= 1e6):
            raise UnitError(f"QuantizedDepth: must have 0 <= near < far in metres, got {self.near:g} and {self.far:g}")
        if self.is_log and not self.near + self.shift > 0:
            raise UnitError(f"QuantizedDepth: near + shift must be above 0, got {self.near:g} + {self.shift:g}")

    @functools.cached_property
    def metres(self) -> NDArray[np.float64]:
        """(4096,) the depth of each code."""
        return self._at(np.arange(CODES))

    def _at(self, codes: NDArray[Any]) -> NDArray[np.float64]:
        """Return the depths of codes, which need not be whole."""
        share = codes / (CODES - 1)
        if not self.is_log:
            return self.near + (self.far - self.near) * share
        low, high = math.log(self.near + self.shift), math.log(self.far + self.shift)
        return np.exp(low + (high - low) * share) - self.shift

    def decoded(self, codes: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Return metres; the first and the last code, where what was clipped came to lie, become 0, "no reading"."""
        table = self.metres.astype(np.float32)
        table[[0, -1]] = 0.0
        return table[np.minimum(codes, CODES - 1)]

    def error(self, metres: float) -> float:
        """Return by how many metres, at most, rounding to codes moved what was decoded as ``metres`` or nearer."""
        code = np.abs(self.metres - metres).argmin()
        low, here, high = self._at(np.array([code - _ROUNDED, code, code + _ROUNDED]))
        return float(max(high - here, here - low))
