"""Does the color image lie on the depth image?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from torch import Tensor

from pcdata.structures import DepthFrame
from pcdata.threads import in_threads
from pcdata.validation.capture_check import register_check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.measures.edge_offset import (
    SHIFT_LIMIT,
    TELLABLE,
    EdgeOffset,
    edge_votes,
    offset_from_votes,
)
from pcdata.verdicts import Finding, Verdict

NAME = "color_registration"

_MEND = (
    "register depth to color with the factory's extrinsics, at this resolution; check that both images are of "
    f"one moment (shifts beyond {SHIFT_LIMIT} pixels are not found)"
)


@dataclass
class _Votes:
    """What the captures of one series say together."""

    of_views: list[tuple[Tensor, int]] = field(default_factory=list)  # as of edge_votes, summed over the captures
    num_captures: int = 0

    def add(self, votes: list[tuple[Tensor, int]]) -> None:
        """Add up the votes, of captures with equal numbers of views and resolution."""
        if not self.of_views:
            self.of_views = votes
        elif [one.shape for one, _ in votes] == [one.shape for one, _ in self.of_views]:
            self.of_views = [(a + b, m + n) for (a, m), (b, n) in zip(self.of_views, votes)]
        else:
            return
        self.num_captures += 1


def _judged_together(votes: _Votes, limits: CaptureLimits) -> list[Finding]:
    """Judge the votes of two captures or more."""
    if votes.num_captures < 2:
        return []
    return [_judged(*one, limits, view) for view, one in enumerate(votes.of_views)]


@register_check(
    "Does the color image lie on the depth image?",
    findings={
        NAME: (
            "shift between color and depth at the rims of near surfaces, in pixels",
            "{0.color_shift:g}",
            "above {0.color_shift:g} beyond doubt",
            "halfway between registered and off by 3 pixels",
        )
    },
    remembers=_Votes,
    whole=_judged_together,
)
def color_on_depth(frame: DepthFrame, limits: CaptureLimits, before: Sequence[Finding], votes: _Votes) -> list[Finding]:
    """Judge the shift between color and depth at the rims of near surfaces, in every view that has color."""
    if frame.colors is None:
        return []
    found = in_threads(lambda pair: edge_votes(*pair), zip(frame.depth, frame.colors))
    votes.add(found)
    return in_threads(lambda view: _judged(*found[view], limits, view), range(len(found)))


def _judged(votes: Tensor, num_edges: int, limits: CaptureLimits, view: int) -> Finding:
    """Judge the shift between color and depth at the rims of near surfaces.

    It fails when even the shortest possible shift is beyond the limit, passes when the shift is within it and one of 3
    pixels can be ruled out, and is unknown otherwise.
    """
    offset = offset_from_votes(votes, num_edges)
    if offset.problem is None and offset.least_length > limits.color_shift:
        verdict, advice = Verdict.FAIL, _MEND
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
