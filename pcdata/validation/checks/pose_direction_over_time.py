"""Do the poses of a moving camera lead where they say? What it sees now agrees with what it saw before."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import ClassVar

from pcdata.alignment.view_agreement import Agreement
from pcdata.structures import DepthFrame
from pcdata.validation.capture_check import Check, views_failing
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.checks.pose_direction import PoseDirection, direction_check, judged_as_given
from pcdata.validation.measures.pose_conventions import (
    CONVENTIONS,
    PosedView,
    agreement,
    explains_more,
    has_moved,
    posed_views,
    share,
)
from pcdata.verdicts import Finding, Verdict

_PAIRS = 2  # pairs of captures that must speak for a convention: one may be an accident
_OUTNUMBERED = 3  # times as many must speak for it as against it


class PoseDirectionOverTime(Check):
    """Compares each capture of a moving camera with an earlier one of the same camera; keeps one depth image."""

    question = "Do the poses of a moving camera lead where they say?"
    findings: ClassVar = PoseDirection.findings
    compares = True

    def __init__(self, limits: CaptureLimits) -> None:
        super().__init__(limits)
        self._earlier: PosedView | None = None
        self._compared = 0  # pairs
        self._agreement = Agreement(0, 0)  # of all pairs, as given
        self._for: Counter[str] = Counter()  # pairs that a convention explains clearly better than what is given
        self._against: Counter[str] = Counter()  # pairs that it explains clearly worse

    def frame(self, frame: DepthFrame, before: Sequence[Finding]) -> list[Finding]:
        """Judge the pose of the next capture; says nothing until the camera has moved.

        A convention is named once two pairs of captures speak for it, and three times as many as against it. Depth of
        another moment or another unit contradicts right poses: it neither accuses them nor is kept.
        """
        if views_failing(before, "repeated_depth", "depth_unit"):
            return []
        views = posed_views(frame)
        if len(views) != 1:
            return []
        earlier, now = self._earlier, views[0]
        if earlier is not None and not has_moved(earlier.pose, now.pose):
            return []
        self._earlier = now
        if earlier is None:
            return []
        given = agreement(earlier, now)
        shares = {name: share(agreement(earlier, now, read, read)) for name, read in CONVENTIONS.items()}
        better = self._count(given, shares)
        who = f"{earlier.sample_id!r} and this capture"
        found = f"{who} agree at {100 * share(given):.0f} % of {given.compared:,} readings that both can see"
        name = max(better, key=lambda one: shares[one], default="")
        if name and self._is_established(name, _PAIRS):
            return [_fails(given, f"{found}; {100 * shares[name]:.0f} % would if the poses were {name}", name)]
        if name:
            found += "; they fit another convention better, but the other captures do not say so"
            advice = (
                "see pose_direction (all captures); in one capture alone: was its depth, or its pose, of another time?"
            )
            return [direction_check(Verdict.WARN, given, found, advice)]
        return [judged_as_given(given, found, who)]

    def whole(self) -> list[Finding]:
        """Judge what all pairs of captures tell together; a recording of two captures has one pair alone."""
        if not self._compared:
            return []
        who = "captures and those before them"
        found = f"{who} agree at {100 * share(self._agreement):.0f} % of the readings that both can see"
        needed = min(_PAIRS, self._compared)
        name = max(self._for, key=lambda one: self._for[one], default="")
        if name and self._is_established(name, needed):
            pairs = f"{self._for[name]} of {self._compared} pairs of captures"
            return [_fails(self._agreement, f"{found}; {pairs} fit clearly better if the poses were {name}", name)]
        return [judged_as_given(self._agreement, found, who)]

    def _count(self, given: Agreement, shares: dict[str, float]) -> list[str]:
        """Add one pair to the votes; return the conventions that explain it better."""
        own = share(given)
        better = [name for name, read in shares.items() if explains_more(read, own)]
        self._for.update(better)
        self._against.update(name for name, read in shares.items() if explains_more(own, read))
        self._compared += 1
        self._agreement = Agreement(self._agreement.agree + given.agree, self._agreement.compared + given.compared)
        return better

    def _is_established(self, name: str, needed: int) -> bool:
        return self._for[name] >= max(needed, _OUTNUMBERED * self._against[name])


def _fails(given: Agreement, found: str, name: str) -> Finding:
    advice = f"the poses look like {name}: convert them to world_from_camera with OpenCV axes, in metres"
    return direction_check(Verdict.FAIL, given, found, advice)
