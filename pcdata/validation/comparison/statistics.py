"""Is a difference between two sources more than what captures of one source differ by?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ALPHA = 0.01  # of a comparison: the chance that sources that are the same differ in anything
FEWEST = 3  # captures that tell how much captures differ
_TRIMMED = 0.2  # of the captures at either end, which a few broken ones do not get beyond
_LEAST_ORDERED = 8  # captures that tell whether those near each other are alike


@dataclass(frozen=True)
class Tested:
    """Two samples of one quantity."""

    a: float  # the mean of the middle 60 %
    b: float
    error: float  # the standard error of b - a; NaN = too few captures
    freedom: float  # of Student's distribution
    p: float  # chance of such a difference between captures of one source; NaN = too few captures

    def seen_from(self, alpha: float) -> float:
        """The smallest difference that would have been told from none."""
        from scipy.stats import t

        return float(t.isf(alpha / 2, self.freedom) * self.error) if math.isfinite(self.error) else math.inf


def compared(a: NDArray[np.float64], b: NDArray[np.float64]) -> Tested:
    """Compare trimmed means by Yuen's test, with as many captures as are worth one of their own.

    Where one source has too few, captures of both are taken to differ as much as those of the other.

    Source: Yuen, The two-sample trimmed t for unequal population variances, Biometrika 61(1), 1974; Geyer, Practical
    Markov chain Monte Carlo, 1992, for the number of independent captures in a series.
    """
    from scipy.stats import t

    a, b = (one[np.isfinite(one)] for one in (a, b))
    if not len(a) or not len(b):
        middle_a, middle_b = (float(np.mean(one)) if len(one) else math.nan for one in (a, b))
        return Tested(middle_a, middle_b, math.nan, math.nan, math.nan)
    (mean_a, spread_a, worth_a), (mean_b, spread_b, worth_b) = map(_summed, (a, b))
    if worth_a < FEWEST and worth_b < FEWEST:
        return Tested(mean_a, mean_b, math.nan, math.nan, math.nan)
    if worth_a < FEWEST or worth_b < FEWEST:
        spread, worth = (spread_b, worth_b) if worth_a < FEWEST else (spread_a, worth_a)
        square, freedom = spread**2 * (1 / worth_a + 1 / worth_b), worth - 1
    else:
        own = spread_a**2 / worth_a, spread_b**2 / worth_b
        square = sum(own)
        parts = sum(one**2 / (worth - 1) for one, worth in zip(own, (worth_a, worth_b)))
        freedom = square**2 / parts if parts > 0 else worth_a + worth_b - 2
    if square <= 0:
        return Tested(mean_a, mean_b, 0.0, freedom, float(mean_a == mean_b))
    return Tested(mean_a, mean_b, square**0.5, freedom, 2 * float(t.sf(abs(mean_b - mean_a) / square**0.5, freedom)))


def _summed(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the trimmed mean, the standard deviation that belongs to it, and the captures that it rests on."""
    count = len(values)
    cut = int(_TRIMMED * count)
    rising = np.sort(values)
    kept = rising[cut : count - cut]
    limited = np.clip(values, kept[0], kept[-1])
    worth = len(kept) * worth_of(values) / count
    spread = float(limited.std(ddof=1)) * ((count - 1) / max(len(kept) - 1, 1)) ** 0.5 if count > 1 else 0.0
    return float(kept.mean()), spread, worth


def worth_of(values: NDArray[np.float64]) -> float:
    """Return how many independent captures a series in order tells as much as; those near each other may be alike."""
    count = len(values)
    off = values - values.mean()
    square = float(off @ off)
    if count < _LEAST_ORDERED or square <= 0:
        return float(count)
    alike = np.correlate(off, off, "full")[count - 1 :] / square
    total = 0.0
    for first in range(1, count - 1, 2):
        pair = float(alike[first] + alike[first + 1])
        if pair <= 0:
            break
        total += pair
    return float(min(count, max(1.0, count / (1 + 2 * total))))


def significant(chances: Sequence[float], alpha: float = ALPHA) -> list[bool]:
    """Say which differences are more than chance, all of them together: Holm's rule.

    Source: Holm, A simple sequentially rejective multiple test procedure, Scandinavian Journal of Statistics 6, 1979.
    """
    known = sorted((p, place) for place, p in enumerate(chances) if not math.isnan(p))
    found = [False] * len(chances)
    for rank, (p, place) in enumerate(known):
        if p > alpha / (len(known) - rank):
            break
        found[place] = True
    return found
