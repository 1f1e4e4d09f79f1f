"""Does the colour image lie on the depth image?"""

from __future__ import annotations

from pcdata.structures import DepthFrame
from pcdata.validation.limits import CaptureLimits
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


def frame_votes(frame: DepthFrame) -> list[EdgeVotes]:
    """Return every view's votes for the offset between colour and depth; none where there is no colour."""
    if frame.colors is None:
        return []
    return [edge_votes(depth, colors) for depth, colors in zip(frame.depth, frame.colors)]


def registration_check(votes: EdgeVotes, limits: CaptureLimits, view: int) -> Finding:
    """Judge the shift between colour and depth at the rims of near surfaces.

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
        f"colour lies {abs(x):.1f} (+-{off_x:.1f}) pixels {'right' if x > 0 else 'left'} of and "
        f"{abs(y):.1f} (+-{off_y:.1f}) {'below' if y > 0 else 'above'} depth, at {offset.num_edges} rim points"
    )


def _reason(offset: EdgeOffset) -> str:
    return _in_words(offset) if offset.problem is None else offset.problem


def _mend(offset: EdgeOffset) -> str:
    return (
        "register depth to colour with the factory's extrinsics, at this resolution; check that both images are of "
        f"one moment (shifts beyond {SHIFT_LIMIT} pixels are not found)"
    )
