"""Latencies in a histogram of fixed size: percentiles of any number of frames in a few kilobytes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray

_SHORTEST, _LONGEST = 1e-6, 1e3  # seconds: what lies outside is counted in the first and the last bin
_PER_FACTOR_E = 50  # bins per factor e: each is 2 % wide
_WAITING = 64  # latencies
_BINS = math.ceil(_PER_FACTOR_E * math.log(_LONGEST / _SHORTEST)) + 1


@dataclass(frozen=True, kw_only=True)
class Latency:
    """Percentiles in seconds; each is at most 2 % above the true one and never below, the worst is exact."""

    count: int
    mean: float
    median: float
    p90: float
    p99: float
    p999: float
    worst: float


class Histogram:
    """Counts of latencies in bins that grow by 2 %: one thread adds, any may read."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, np.int64)
        self._waiting: list[float] = []  # to be put into bins: many at once take little longer than one
        self._moving = Lock()
        self._sum = self._worst = 0.0

    def add(self, seconds: float) -> None:
        """Count one latency."""
        self._sum += seconds
        self._worst = max(self._worst, seconds)
        self._waiting.append(seconds)
        if len(self._waiting) >= _WAITING:
            with self._moving:
                _count(self._waiting, self._counts)
                self._waiting.clear()

    @property
    def counts(self) -> NDArray[np.int64]:
        """(bins,) how many there were of each length."""
        with self._moving:
            counts = self._counts.copy()
            _count(self._waiting, counts)
            return counts

    def percentile(self, share: float) -> float:
        """Return the seconds that ``share`` (0..1) of all latencies do not exceed; 0 where there are none."""
        totals = self.counts.cumsum()
        total = int(totals[-1])
        if not total:
            return 0.0
        place = int(np.searchsorted(totals, max(1, math.ceil(share * total))))
        edge = _SHORTEST * math.exp(place / _PER_FACTOR_E)
        return self._worst if place == _BINS - 1 else min(edge, self._worst)

    def bins(self) -> dict[str, list[float]]:
        """Return the upper ends of the bins from the first to the last that is not empty, and the count of each."""
        counts = self.counts
        used = counts.nonzero()[0]
        places = np.arange(used[0], used[-1] + 1) if len(used) else np.arange(0)
        seconds = _SHORTEST * np.exp(places / _PER_FACTOR_E)
        return {"seconds": seconds.tolist(), "count": counts[places].tolist()}

    def summary(self) -> Latency:
        """Return what a reader asks for."""
        count = int(self.counts.sum())
        median, p90, p99, p999 = (self.percentile(share) for share in (0.5, 0.9, 0.99, 0.999))
        return Latency(
            count=count,
            mean=self._sum / max(count, 1),
            median=median,
            p90=p90,
            p99=p99,
            p999=p999,
            worst=self._worst,
        )


def _count(latencies: Sequence[float], counts: NDArray[np.int64]) -> None:
    for seconds in latencies:
        place = math.ceil(_PER_FACTOR_E * math.log(max(seconds, _SHORTEST) / _SHORTEST))
        counts[min(place, _BINS - 1)] += 1
