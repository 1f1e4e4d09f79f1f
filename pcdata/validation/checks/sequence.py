"""What only a series of captures can tell: images that repeat, and clocks."""

from __future__ import annotations

import hashlib
from collections import OrderedDict, deque
from collections.abc import Sequence
from statistics import median
from typing import ClassVar

from torch import Tensor

from pcdata.structures import DepthFrame
from pcdata.validation.capture_check import Check, Explained
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.view_names import view_names
from pcdata.verdicts import Finding, Verdict, graded

_REMEMBERED = 10_000  # captures: an image that comes again later than this goes unnoticed
_INTERVALS = 100  # the usual interval is the median of so many
_GAP = 2.5  # usual intervals without a capture: two frames are lost at least
_SENSORS_DIFFER = "no sensor gives one image twice: the stream stands still, or captures were stored twice"


_REPEATS = Explained(
    "image is bit for bit that of an earlier capture of this camera",
    "no",
    "yes",
    f"no sensor gives one image twice; remembers {_REMEMBERED:,} images",
)


class Repeats(Check):
    """Compares every image of a view with those of earlier captures, bit for bit, by their hashes."""

    question = "Is every image a new one?"
    findings: ClassVar = {"repeated_depth": _REPEATS, "repeated_color": _REPEATS}
    compares = True

    def __init__(self, limits: CaptureLimits) -> None:
        super().__init__(limits)
        self._seen: dict[tuple[str, int], OrderedDict[bytes, tuple[int, str]]] = {}
        self._count = 0

    def frame(self, frame: DepthFrame, before: Sequence[Finding]) -> list[Finding]:
        """Judge the views of the next capture."""
        self._count += 1
        checks = []
        for view in range(frame.num_views):
            depth = self._earlier("depth", view, frame.depth[view], frame.sample_id)
            checks.append(_repeat("repeated_depth", depth, view))
            if frame.colors is not None:
                color = self._earlier("color", view, frame.colors[view], frame.sample_id)
                checks.append(_repeat("repeated_color", color, view))
        return checks

    def _earlier(self, image: str, view: int, pixels: Tensor, sample_id: str) -> tuple[int, str] | None:
        """Return how many captures ago this image was there, and in which one."""
        digest = hashlib.blake2b(pixels.contiguous().cpu().numpy().data, digest_size=16).digest()
        seen = self._seen.setdefault((image, view), OrderedDict())
        before = seen.get(digest)
        seen[digest] = self._count, sample_id
        seen.move_to_end(digest)
        if len(seen) > _REMEMBERED:
            seen.popitem(last=False)
        return None if before is None else (self._count - before[0], before[1])


def _repeat(name: str, before: tuple[int, str] | None, view: int) -> Finding:
    what = "depth" if name == "repeated_depth" else "color"
    found = f"the {what} image is a new one"
    if before is not None:
        ago, sample_id = before
        found = f"the {what} image is bit for bit that of {sample_id!r}, {ago} capture{'s' * (ago > 1)} before"
    return graded(
        name,
        float(before is not None),
        limits=(0.0, 0.0),
        found=found,
        advice=f"{_SENSORS_DIFFER}; drop the repetitions (a simulator without noise may repeat itself on purpose)",
        view=view,
    )


class Clock(Check):
    """Judges ``provenance["timestamps"]``, the seconds of every view, where a capture has them."""

    question = "Does time run forwards, and at once for all cameras?"
    findings: ClassVar = {
        "clock": Explained(
            "seconds since the capture before",
            f"up to {_GAP:g} usual intervals (warns beyond)",
            "0 or less",
            'where `timestamps.json` (folder layout) or `provenance["timestamps"]` has times',
        ),
        "sync": Explained(
            "seconds between the views of one capture",
            "{0.sync[0]:.4f}",
            "above {0.sync[1]:.4f}",
            "half a frame and a whole one at 30 per second",
        ),
    }
    compares = True

    def __init__(self, limits: CaptureLimits) -> None:
        super().__init__(limits)
        self._last: list[float] = []
        self._intervals: deque[float] = deque(maxlen=_INTERVALS)

    def frame(self, frame: DepthFrame, before: Sequence[Finding]) -> list[Finding]:
        """Judge the times of the next capture."""
        times = frame.provenance.get("timestamps")
        if times is None:
            return []
        checks = [self._sync(times, view_names(frame.provenance, len(times)))] if len(times) > 1 else []
        if len(self._last) == len(times):
            checks.append(self._interval(min(now - last for now, last in zip(times, self._last))))
        self._last = list(times)
        return checks

    def _sync(self, times: list[float], names: list[str]) -> Finding:
        apart = max(times) - min(times)
        early, late = times.index(min(times)), times.index(max(times))
        return graded(
            "sync",
            apart,
            limits=self.limits.sync,
            found=f"{names[late]} is {1e3 * apart:.1f} ms later than {names[early]}",
            advice="trigger the cameras together, or pair their images by nearest time; what moves is in two places",
            unit="s",
        )

    def _interval(self, interval: float) -> Finding:
        usual = median(self._intervals) if self._intervals else interval
        if interval > 0:
            self._intervals.append(interval)
        verdict = Verdict.FAIL if interval <= 0 else Verdict.WARN if interval > _GAP * usual else Verdict.PASS
        advice = {
            Verdict.PASS: "",
            Verdict.WARN: "captures are missing here: do not treat the two as consecutive",
            Verdict.FAIL: "time runs backwards or stands still: sort the captures by time, drop the repetitions",
        }[verdict]
        return Finding(
            name="clock",
            verdict=verdict,
            found=f"{interval:.4g} s after the capture before, usually {usual:.4g} s",
            value=interval,
            threshold=_GAP * usual,
            fails_at=0.0,
            unit="s",
            advice=advice,
        )
