"""Is depth measured along the optical axis? Read as anything else, the largest plane of one view is bent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pcdata.structures import DepthFrame
from pcdata.validation.capture_check import register_check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.measures.plane_bend import LEAST_SHARE, MOST_SPREAD, PlaneBend, plane_bends
from pcdata.validation.measures.pose_conventions import RAYS, advice_of
from pcdata.verdicts import Finding, Verdict

NAME = "depth_axis"
_PLANE = 0.3  # as a power: planes of real cameras came out at up to 0.1
_BENT = 0.15  # from one whole power; a ball bends so too where its radius is its distance, to this part
_ERROR = 0.12  # of the power: four of it between plane and half bent
_OTHER = 0.25  # as a power: what only surfaces curved by themselves have
_LEAST_GAIN = 1.3  # times the readings of the largest plane of depth as given
_LEAST_BULGE = 0.008  # of the distance: sensors bend planes by up to 0.002
_LEAST_CLEAR = 2.0  # times the noise of single readings
_NO_PLANE = "show a table, a floor or a wall over much of the image, or give several posed views"


@register_check(
    "Is depth measured along the optical axis?",
    findings={
        NAME: (
            "power of the ray's length by which the largest plane is bent: 0 = z, 1 = lengths along the rays, -1 = z "
            "divided by the length of the ray",
            f"within {_PLANE:g} of 0",
            f"within {_BENT:g} of 1 or -1",
            f"a plane read wrongly is a bowl. Judged where one plane holds {LEAST_SHARE:.0%} of the readings, is so "
            f"wide that it would bend by {_LEAST_BULGE:.1%} of the distance and {_LEAST_CLEAR:g} times the noise, its "
            f"parts agree to {_ERROR:g}, few readings lie just off it, and it has no bend that depth does not "
            "explain; else unknown",
        )
    },
)
def depth_axis(frame: DepthFrame, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Judge every view by itself, posed or not; those without a reading are left out."""
    return [
        _judged(bend, view, frame.provenance)
        for view, (depth, bend) in enumerate(zip(frame.depth, plane_bends(frame)))
        if bool((depth > 0).any())
    ]


def _judged(bend: PlaneBend | None, view: int, facts: Mapping[str, Any]) -> Finding:
    if bend is None:
        return _finding(Verdict.UNKNOWN, "not measurable: no plane", _NO_PLANE, view)
    which = f"the largest plane, {bend.share:.0%} of the readings,"
    power = f"{bend.power:.2f} +- {bend.error:.2f}"
    if bend.share < LEAST_SHARE:
        return _finding(Verdict.UNKNOWN, f"not measurable: {which} is too small", _NO_PLANE, view)
    if bend.spread > MOST_SPREAD:
        return _finding(Verdict.UNKNOWN, "not measurable: what is most like a plane is none", _NO_PLANE, view)
    if bend.bulge < max(_LEAST_BULGE, _LEAST_CLEAR * bend.noise) or not bend.error <= _ERROR:
        found = f"not measurable: {which} is not wide enough for its noise of {bend.noise:.2%} of the distance"
        return _finding(Verdict.UNKNOWN, found, _NO_PLANE, view)
    if abs(bend.power) <= _PLANE:
        return _finding(Verdict.PASS, f"{which} is plane: bent by {power} powers of the ray's length", "", view, bend)
    wrong = round(bend.power)
    is_named = wrong in (1, -1) and abs(bend.power - wrong) <= _BENT and bend.other <= _OTHER
    if not is_named or (1.0 < bend.gain < _LEAST_GAIN):
        found = f"not measurable: {which} is curved, but not as any reading of depth would bend it ({power})"
        return _finding(Verdict.UNKNOWN, found, _NO_PLANE, view)
    return _finding(
        Verdict.FAIL,
        f"{which} is bent like a bowl, by {power} powers of the ray's length; it is plane if depth was "
        + (RAYS if wrong == 1 else "z, and was divided by the length of each ray as if it were along the rays"),
        advice_of(RAYS) if wrong == 1 else _undo(facts),
        view,
        bend,
    )


def _undo(facts: Mapping[str, Any]) -> str:
    """Say how depth that was converted although it was z becomes z again."""
    convention = facts.get("convention")
    if isinstance(convention, Mapping) and convention.get("depth") == "ray":
        return "these files hold z already: read them without convention.depth=ray"
    return (
        "who wrote these files took z for lengths along the rays: multiply depth by "
        "pcdata.functional.depth.rendered.ray_lengths(size, intrinsics, distortion) and write it again"
    )


def _finding(verdict: Verdict, found: str, advice: str, view: int, bend: PlaneBend | None = None) -> Finding:
    return Finding(
        name=NAME,
        verdict=verdict,
        found=found,
        value=None if bend is None else abs(bend.power),
        threshold=_PLANE,
        fails_at=1 - _BENT,
        advice=advice,
        view=view,
    )
