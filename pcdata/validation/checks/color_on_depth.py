"""Does the color image lie on the depth image?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from pcdata.structures import DepthFrame
from pcdata.validation.capture_check import Check, Explained
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.measures.edge_offset import (
    SHIFT_LIMIT,
    TELLABLE,
    EdgeOffset,
    EdgeVotes,
    edge_votes,
    offset_from_votes,
)
from pcdata.verdicts import Finding, Verdict

NAME = "color_registration"


class ColorOnDepth(Check):
    """The shift between color and depth at the rims of near surfaces, in each capture and in all together."""

    question = "Does the color image lie on the depth image?"
    findings: ClassVar = {
        NAME: Explained(
            "shift between color and depth at the rims of near surfaces, in pixels",
            "{0.color_shift:g}",
            "above {0.color_shift:g} beyond doubt",
            "halfway between registered and off by 3 pixels",
        )
    }

    def __init__(self, limits: CaptureLimits) -> None:
        super().__init__(limits)
        self._votes: list[EdgeVotes] = []  # by view, summed over the captures
        self._voted = 0

    def frame(self, frame: DepthFrame, before: Sequence[Finding]) -> list[Finding]:
        """Judge every view that has color."""
        if frame.colors is None:
            return []
        votes = [edge_votes(depth, colors) for depth, colors in zip(frame.depth, frame.colors)]
        self._add(votes)
        return [_judged(one, self.limits, view) for view, one in enumerate(votes)]

    def whole(self) -> list[Finding]:
        """Judge the votes of two captures or more."""
        return [_judged(one, self.limits, view) for view, one in enumerate(self._votes) if self._voted > 1]

    def _add(self, votes: list[EdgeVotes]) -> None:
        """Add up the votes, of captures with equal numbers of views and resolution."""
        if not self._votes:
            self._votes = votes
        elif [one.scale for one in votes] == [one.scale for one in self._votes]:
            self._votes = [total + one for total, one in zip(self._votes, votes)]
        else:
            return
        self._voted += 1


def _judged(votes: EdgeVotes, limits: CaptureLimits, view: int) -> Finding:
    """Judge the shift between color and depth at the rims of near surfaces.

    It fails when even the shortest possible shift is beyond the limit, passes when the shift is within it and one of 3
    pixels can be ruled out, and is unknown otherwise.
    """
    offset = offset_from_votes(votes)
    if offset.problem is None and offset.least_length > limits.color_shift:
        verdict, advice = Verdict.FAIL, _mend(offset)
    elif offset.problem is None and offset.length <= limits.color_shift and offset.greatest_length < TELLABLE:
        verdict, advice = Verdict.PASS, ""
    else:
        verdict = Verdict.UNKNOWN
        advice = "show the camera objects that stand clear of their background on all sides, or look at an overlay"
    return Finding(
        name=NAME,
        verdict=verdict,
        found=_in_words(offset) if verdict is not Verdict.UNKNOWN else f"not measurable: {_reason(offset)}",
        value=offset.length if offset.problem is None else None,
        threshold=limits.color_shift,
        fails_at=limits.color_shift,
        unit="pixels",
        advice=advice,
        view=view,
    )


def _in_words(offset: EdgeOffset) -> str:
    (x, y), (off_x, off_y) = offset.shift, offset.spread
    return (
        f"color lies {abs(x):.1f} (+-{off_x:.1f}) pixels {'right' if x > 0 else 'left'} of and "
        f"{abs(y):.1f} (+-{off_y:.1f}) {'below' if y > 0 else 'above'} depth, at {offset.num_edges} rim points"
    )


def _reason(offset: EdgeOffset) -> str:
    return _in_words(offset) if offset.problem is None else offset.problem


def _mend(offset: EdgeOffset) -> str:
    return (
        "register depth to color with the factory's extrinsics, at this resolution; check that both images are of "
        f"one moment (shifts beyond {SHIFT_LIMIT} pixels are not found)"
    )
