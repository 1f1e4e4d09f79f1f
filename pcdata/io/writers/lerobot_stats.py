"""Statistics of features as LeRobot keeps them, of every episode and of all: what policies normalize by.

Source: LeRobot, ``datasets/compute_stats.py`` (0.6): of color in 0 .. 1 by channel, of all else by its last axis;
quantiles of all episodes are the average of theirs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_STRIDE = 2  # pixels: a quarter of them tells as much as all

Stats = dict[str, NDArray[Any]]


def stats_of(values: NDArray[Any], steps: int) -> Stats:
    """Return the statistics of one feature over an episode, from (steps, ...) numbers."""
    rows = values.reshape(-1, values.shape[-1] if values.ndim > 1 else 1).astype(np.float64)
    found = {"min": rows.min(axis=0), "max": rows.max(axis=0), "mean": rows.mean(axis=0), "std": rows.std(axis=0)}
    quantiles = np.quantile(rows, list(_QUANTILES.values()), axis=0)
    return {**found, "count": np.array([steps]), **dict(zip(_QUANTILES, quantiles))}


class ColorStats:
    """Statistics of color images, counted as they come."""

    def __init__(self) -> None:
        self._counts = np.zeros((3, 256), dtype=np.int64)
        self._images = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """Count one (H, W, 3) image."""
        for channel in range(3):
            self._counts[channel] += np.bincount(image[::_STRIDE, ::_STRIDE, channel].reshape(-1), minlength=256)
        self._images += 1

    def stats(self) -> Stats:
        """Return them, each (3, 1, 1)."""
        levels = np.arange(256) / 255.0
        share = self._counts / self._counts.sum(axis=1, keepdims=True)
        mean = share @ levels
        std = np.sqrt(np.maximum(0.0, share @ levels**2 - mean**2))
        below = np.cumsum(share, axis=1)
        present = self._counts > 0
        found = {
            "min": levels[present.argmax(axis=1)],
            "max": levels[255 - present[:, ::-1].argmax(axis=1)],
            "mean": mean,
            "std": std,
            **{name: levels[(below >= part - 1e-12).argmax(axis=1)] for name, part in _QUANTILES.items()},
        }
        return {**{name: value.reshape(3, 1, 1) for name, value in found.items()}, "count": np.array([self._images])}


class AllStats:
    """Statistics of all episodes, from those of each."""

    def __init__(self) -> None:
        self._sums: dict[str, Stats] = {}

    def add(self, episode: Mapping[str, Stats]) -> None:
        """Take those of one more episode, by feature."""
        for key, own in episode.items():
            count = float(own["count"][0])
            weighted = {name: own[name] * count for name in ("mean", *_QUANTILES)}
            weighted["squares"] = (own["std"] ** 2 + own["mean"] ** 2) * count
            if key not in self._sums:
                self._sums[key] = {**weighted, "min": own["min"], "max": own["max"], "count": own["count"].copy()}
                continue
            sums = self._sums[key]
            for name, value in weighted.items():
                sums[name] = sums[name] + value
            sums["min"], sums["max"] = np.minimum(sums["min"], own["min"]), np.maximum(sums["max"], own["max"])
            sums["count"] = sums["count"] + own["count"]

    def as_json(self) -> dict[str, dict[str, Any]]:
        """Return plain lists by feature and statistic."""
        found = {}
        for key, sums in self._sums.items():
            count = float(sums["count"][0])
            mean = sums["mean"] / count
            stats = {
                "min": sums["min"],
                "max": sums["max"],
                "mean": mean,
                "std": np.sqrt(np.maximum(0.0, sums["squares"] / count - mean**2)),
                "count": sums["count"],
                **{name: sums[name] / count for name in _QUANTILES},
            }
            found[key] = {name: value.tolist() for name, value in stats.items()}
        return found
