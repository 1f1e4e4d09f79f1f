"""Distances in classes, the same for everything that is compared: half octaves from 0.125 m."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_FIRST, _STEPS, _COUNT = 0.125, 2, 18  # metres; classes for every doubling; up to 64 m
NUM_CLASSES = _COUNT
_FARTHEST = 2.0**100  # metres, of which the square is a float still


def class_of(distance: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the class of every distance in metres, 0 to NUM_CLASSES - 1."""
    place = np.floor(_STEPS * np.log2(np.maximum(distance, _FIRST) / _FIRST))
    return np.clip(place, 0, _COUNT - 1).astype(np.int64)


def middle_of(number: int) -> float:
    """Return the distance in the middle of a class, in metres."""
    return float(_FIRST * 2 ** ((number + 0.5) / _STEPS))


def in_words(number: int) -> str:
    """Return the limits of a class."""
    low, high = (_FIRST * 2 ** ((number + more) / _STEPS) for more in (0, 1))
    return f"{low:.2g} to {high:.2g} m"


def octave(distance: float) -> float:
    """Return 1, 2, 4, ... by the distance in metres: lengths that grow with it, but not with every millimetre."""
    return float(2.0 ** max(0, round(np.log2(min(max(distance, 1e-3), _FARTHEST)))))
