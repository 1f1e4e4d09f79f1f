"""Streams that run at rates of their own, joined on the clock of one.

A stream may come in any order, and may hold a time twice. Times are whole ticks, such as the nanoseconds of a recorder,
which are compared exactly, or seconds. Nothing is filled in: what has no partner within the stated gap has none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CaptureError, ConfigError
from pcdata.geometry import rigid

Rule = Literal["nearest", "linear", "slerp", "step"]
RULES = ("nearest", "linear", "slerp", "step")
_PARALLEL = 0.9995  # cosine of half the turn above which slerp and a straight line are the same in float64

Times = Sequence[int] | Sequence[float] | NDArray[Any]


def allow_more(option: str, seconds: float) -> str:
    """Say which value of an option lets streams join that are so far apart, or that none does."""
    if not math.isfinite(seconds):
        return "there is nothing to join with"
    digit = 10.0 ** (math.floor(math.log10(seconds)) - 2) if seconds > 0 else 0.001
    enough = f"{math.ceil(seconds / digit + 1e-6) * digit:.3g}"  # the third digit rounded up, or it would not be
    return f"allow more by {option}={enough} (--{option.replace('_', '-')} {enough})"


class Joined(NamedTuple):
    """What of a stream belongs to each time of the clock, N, and what that leaves.

    ``share`` is of ``after``: the value at a time is (1 - share) of ``before`` and share of ``after``.
    """

    before: NDArray[np.int64]  # (N,) places in the stream, as it was given; -1 = no partner
    after: NDArray[np.int64]  # (N,); that of ``before`` unless the time lies between the two
    share: NDArray[np.float64]  # (N,) 0 .. 1
    gap: NDArray[np.float64]  # (N,) ticks to the farther of the two; infinite where there is none, in or out of reach
    num_stream: int

    @property
    def found(self) -> NDArray[np.bool_]:
        """(N,), where there is a partner."""
        return self.before >= 0

    def counts(self) -> dict[str, int]:
        """Return what was joined, in numbers.

        ``dropped``: of the stream, used for no time; ``doubled``: times that share their message with an earlier one;
        ``interpolated``: times between two messages; ``missing``: times without a partner.
        """
        whole = self.found & (self.before == self.after)
        used = np.union1d(self.before[self.found], self.after[self.found])
        return {
            "messages": self.num_stream,
            "dropped": self.num_stream - len(used),
            "doubled": int(whole.sum()) - len(np.unique(self.before[whole])),
            "interpolated": int((self.found & ~whole).sum()),
            "missing": int((~self.found).sum()),
        }


def joined(times: Times, stream: Times, rule: Rule, max_gap: float = np.inf) -> Joined:
    """Find what of a stream belongs to each time of a clock.

    Args:
        times: (N,) of the clock.
        stream: (M,) of the stream's messages, in any order, in the same unit.
        rule: "nearest": the message nearest in time, of two equally near the earlier; "linear" and "slerp": the two
            around it, or the one of that very time; "step": the last one at or before.
        max_gap: how far a message may be from the time, of two the farther one, in the same unit.

    Of messages of one time the first is taken, by "step" the last.

    Raises:
        ConfigError: no such rule.
    """
    if rule not in RULES:
        raise ConfigError(f"joined: rule must be one of {', '.join(RULES)}, got {rule!r:.100}")
    clock, known = _ticks(times), _ticks(stream)
    order = np.argsort(known, kind="stable")
    ordered = known[order]
    if not len(ordered):
        none = np.full(len(clock), -1, np.int64)
        return Joined(none, none, np.zeros(len(clock)), np.full(len(clock), np.inf), 0)
    low = np.searchsorted(ordered, clock, "left")  # the first at or after
    last = len(ordered) - 1
    share = np.zeros(len(clock))
    if rule == "step":
        before = after = np.searchsorted(ordered, clock, "right") - 1
    else:
        exact = (low <= last) & (ordered[np.minimum(low, last)] == clock)
        before = np.where(exact, low, low - 1)
        after = np.where(low > last, -1, low)  # of "nearest": nothing later
    if rule == "nearest":
        earlier, later = _apart(clock, ordered, before), _apart(clock, ordered, after)
        near = np.where(earlier <= later, before, after)
        before = after = np.searchsorted(ordered, ordered[near], "left")  # the first of its time
    gap = np.maximum(_apart(clock, ordered, before), _apart(clock, ordered, after))
    fits = (gap <= max_gap) & (gap < np.inf)  # infinite: one of the two is not there
    before, after = np.where(fits, before, -1), np.where(fits, after, -1)
    between = fits & (ordered[before] != ordered[after])
    span = (ordered[after] - ordered[before])[between]
    share[between] = (clock - ordered[before])[between] / span
    after = np.where(between, after, before)
    return Joined(np.where(fits, order[before], -1), np.where(fits, order[after], -1), share, gap, len(known))


def _ticks(times: Times) -> NDArray[Any]:
    """Return times as they are: 1.7e18 ns are more than a float64 can hold exactly."""
    known = np.asarray(times)
    return known.astype(np.int64) if known.dtype.kind in "iu" and len(known) else known.astype(np.float64)


def _apart(clock: NDArray[Any], ordered: NDArray[Any], place: NDArray[np.int64]) -> NDArray[np.float64]:
    inside = (place >= 0) & (place < len(ordered))
    return np.where(inside, np.abs(clock - ordered[place.clip(0, len(ordered) - 1)]).astype(np.float64), np.inf)


def mixed(one: NDArray[Any], other: NDArray[Any], share: float) -> NDArray[np.float64]:
    """Return the straight line from one value to the other; at its ends they themselves, bit for bit."""
    if share in (0.0, 1.0):
        return np.asarray(other if share else one, np.float64)
    return np.asarray(one + share * (np.asarray(other, np.float64) - one), np.float64)


class _Partners(NamedTuple):
    """What stands nearest to each time, and what that leaves."""

    place: dict[int, int]  # place in the one stream -> place in the other; none where all are too far
    apart: dict[int, float]  # ticks, of every place: the distance of the nearest
    unused: int  # of the other stream
    doubled: int  # of the other stream that serve more than one


def nearest(times: Times, others: Times, limit: float) -> _Partners:
    """Return, for each time, the other one that is nearest, of two equally near the earlier, within a limit."""
    found = joined(times, others, "nearest", limit)
    counts = found.counts()
    return _Partners(
        {place: int(partner) for place, partner in enumerate(found.before) if partner >= 0},
        {place: float(gap) for place, gap in enumerate(found.gap) if gap < np.inf},
        counts["dropped"],
        counts["doubled"],
    )


class Trajectory:
    """Poses at times, in between them interpolated: straight lines, and turns at a constant rate (slerp)."""

    def __init__(self, where: str, times: Times, positions: NDArray[np.float64], xyzw: NDArray[np.float64]):
        """Take the poses, in any order of time.

        Args:
            where: for messages.
            times: N, seconds, or whole ticks.
            positions: (N, 3) metres.
            xyzw: (N, 4) quaternions, the real part last.

        Raises:
            CaptureError: a number is not finite, two poses are of one time, or a quaternion is no rotation.
        """
        self.times = _ticks(times)
        lengths = np.linalg.norm(xyzw, axis=1)
        if not np.isfinite(self.times).all() or not np.isfinite(positions).all() or not np.isfinite(lengths).all():
            raise CaptureError(f"{where}: times, positions and quaternions must be finite")
        if (np.abs(lengths - 1) > 1e-2).any():
            wrong = int(np.abs(lengths - 1).argmax())
            raise CaptureError(
                f"{where}: quaternion {xyzw[wrong].tolist()} is no rotation, its length is {lengths[wrong]:g}"
            )
        order = np.argsort(self.times, kind="stable")
        self.times, self._positions = self.times[order], positions[order]
        self._turns = (xyzw / lengths[:, None])[order]
        if (np.diff(self.times) <= 0).any():
            twice = self.times[1:][np.diff(self.times) <= 0][0]
            raise CaptureError(f"{where}: two poses are of the time {twice:.6f}; remove one")

    def gap(self, time: float) -> float:
        """Return how far the farther of the two poses around a time is; infinite outside of all."""
        return float(joined([time], self.times, "slerp").gap[0])

    def pose(self, time: float) -> Tensor:  # (4, 4) float64
        """Return the pose at a time within the trajectory."""
        found = joined([time], self.times, "slerp")
        before, after, share = int(found.before[0]), int(found.after[0]), float(found.share[0])
        shift = mixed(self._positions[before], self._positions[after], share)
        turn = torch.from_numpy(slerp(self._turns[before], self._turns[after], share))
        return rigid.from_rotation_translation(rigid.rotation_from_quaternion(turn), torch.from_numpy(shift))


def slerp(one: NDArray[np.float64], other: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """Turn from one unit quaternion to the other at a constant rate, the short way.

    Source: Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985.
    """
    cosine = float(one @ other)
    if cosine < 0:
        other, cosine = -other, -cosine
    if cosine > _PARALLEL:
        mean = (1 - share) * one + share * other
    else:
        angle = np.arccos(cosine)
        mean = (np.sin((1 - share) * angle) * one + np.sin(share * angle) * other) / np.sin(angle)
    return np.asarray(mean / np.linalg.norm(mean), np.float64)
