"""The range of coordinates over many clouds, with and without the zeros that some are padded by."""

from __future__ import annotations

from itertools import repeat

import numpy as np
from numpy.typing import NDArray


class PaddingRanges:
    """Range of x, y, z with and without rows of zeros, by which simulators and some samplers pad short clouds."""

    def __init__(self) -> None:
        self.padded = 0
        self.first = ""
        self.all, self.real = (np.array([[np.inf] * 3, [-np.inf] * 3]) for _ in repeat(None, 2))

    def add(self, sample_id: str, rows: NDArray[np.float32]) -> None:  # (N, 3 or more), x, y, z first
        """Take the points of one cloud in."""
        points = rows[:, :3]
        zero = ~points.any(axis=1)
        if zero.any():
            self.first = self.first or sample_id
            self.padded += 1
        for limits, chosen in ((self.all, points), (self.real, points[~zero])):
            if len(chosen):
                np.minimum(limits[0], chosen.min(axis=0), out=limits[0])
                np.maximum(limits[1], chosen.max(axis=0), out=limits[1])

    def warning(self, name: str) -> str | None:
        """Return what zeros do to the range that a policy of this name scales by; None where no cloud has any."""
        if not self.padded:
            return None
        moved = not np.array_equal(self.all, self.real)
        effect = (
            f"{name} scales x, y, z by their range over all rows, which those zeros widen from {_words(self.real)} to "
            f"{_words(self.all)}"
            if moved
            else f"the range that {name} scales x, y, z by does not change"
        )
        return (
            f"{self.padded} clouds have points at exactly 0 0 0, as padding has (first: sample {self.first!r}); "
            f"{effect}. Pad by repeated points instead: FarthestPointSample(if_short='repeat')"
        )


def _words(limits: NDArray[np.float64]) -> str:
    return " x ".join(f"{low:.3g}..{high:.3g}" for low, high in limits.T)
