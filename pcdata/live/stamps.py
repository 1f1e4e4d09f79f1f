"""The stamps of a stream: late, frozen, out of order, of another clock; and a stream that began anew."""

from __future__ import annotations

import math
from collections.abc import Callable
from numbers import Real

from pcdata.errors import ConfigError
from pcdata.live.faults import Fault

_ANEW = 5  # frames in a row, each newer than the one before and all older than the newest: the stamps began anew


class Stamps:
    """Judges the stamp of each frame by the newest one before it and by the clock."""

    def __init__(self, max_age: float | None, clock: Callable[[], float]) -> None:
        if max_age is not None and not max_age > 0:
            raise ConfigError(f"LivePipeline: max_age must be above 0 seconds, got {max_age!r}")
        self._max_age, self._clock = max_age, clock
        self.restarts = 0
        self.reset()

    def reset(self) -> None:
        """Forget all stamps."""
        self._newest = self._last_old = -math.inf
        self._old_in_a_row = 0

    def age(self, stamp: float | None) -> float | None:
        """Return the seconds since a stamp."""
        return None if stamp is None or not _is_number(stamp) else self._clock() - stamp

    def check(self, stamp: float | None) -> tuple[Fault | None, str]:
        """Return what is wrong with the stamp of the next frame, and remember it."""
        if stamp is None:
            return None, ""
        if not _is_number(stamp):
            return Fault.WRONG_CLOCK, f"LivePipeline: the stamp is {stamp!r:.50}; give seconds"
        if self._max_age is not None:
            age = self._clock() - stamp
            if age < -self._max_age:
                return Fault.WRONG_CLOCK, (
                    f"LivePipeline: the stamp lies {-age:.3g} s in the future; is it seconds of the pipeline's clock?"
                )
            if age > self._max_age:
                self._newest = max(self._newest, stamp)
                return Fault.LATE, f"LivePipeline: the frame is {age:.3g} s old, max_age is {self._max_age:g} s"
        if stamp == self._newest:
            return Fault.FROZEN, "LivePipeline: the stamp is that of the frame before; does the camera stream?"
        if stamp < self._newest and not self._began_anew(stamp):
            return Fault.OUT_OF_ORDER, f"LivePipeline: a frame {self._newest - stamp:.3g} s newer came before this one"
        self._newest, self._old_in_a_row = stamp, 0
        return None, ""

    def _began_anew(self, stamp: float) -> bool:
        """Say whether so many rising stamps lie before the newest that the camera's clock must have been set back."""
        self._old_in_a_row = self._old_in_a_row + 1 if stamp > self._last_old else 1
        self._last_old = stamp
        if self._old_in_a_row < _ANEW:
            return False
        self.restarts += 1
        return True


def _is_number(stamp: object) -> bool:
    if isinstance(stamp, bool):
        return False
    return isinstance(stamp, Real) and math.isfinite(stamp)
