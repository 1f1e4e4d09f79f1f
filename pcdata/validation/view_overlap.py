"""Do the views of one capture see one surface, and which camera is out of place?"""

from __future__ import annotations

import math

from pcdata.errors import PcdataError
from pcdata.structures import DepthFrame
from pcdata.validation.check import Check, Verdict
from pcdata.validation.overlap import verify_overlap
from pcdata.validation.overlap_result import CameraOverlap, OverlapLimits, OverlapResult
from pcdata.validation.view_names import view_names

_VERDICTS = {
    "pass": Verdict.PASS,
    "not measurable": Verdict.WARN,
    "warn": Verdict.WARN,
    "fail": Verdict.FAIL,
}


def overlap_checks(frame: DepthFrame) -> list[Check]:
    """Judge the gap between the surfaces of the views, and how far each camera is out of place.

    Nothing is said of a frame with one view or without poses.
    """
    if frame.num_views < 2 or frame.world_from_camera is None:
        return []
    try:
        result = verify_overlap(frame, names=view_names(frame.provenance, frame.num_views))
    except PcdataError as error:
        return [Check(name="view_gap", verdict=Verdict.WARN, found=f"not measurable: {error}")]
    return [_gap(result), *(_pose(result, view) for view in range(frame.num_views))]


def _gap(result: OverlapResult) -> Check:
    """The widest median gap between two views that overlap, where any do."""
    measured = [pair for pair in result.pairs if math.isfinite(pair.median)]
    failed = [pair for pair in result.pairs if pair.verdict == "fail"]
    worst = max(failed or measured, key=lambda pair: (pair.median, pair.first), default=None)
    passes, fails = result.limits.residual
    if worst is None:
        return Check(
            name="view_gap",
            verdict=Verdict.WARN,
            found="not measurable: no two views overlap",
            threshold=passes,
            fails_at=fails,
            unit="m",
        )
    pair = f"{worst.first} and {worst.second}"
    found = f"half of the surface that {pair} share lies within {1e3 * worst.median:.1f} mm"
    if not math.isfinite(worst.median):
        found = f"{pair} look at one place and share no surface"
    verdict = _VERDICTS[worst.verdict]
    return Check(
        name="view_gap",
        verdict=verdict,
        found=found,
        value=worst.median if math.isfinite(worst.median) else None,
        threshold=passes,
        fails_at=fails,
        unit="m",
        advice="" if verdict is Verdict.PASS else "; ".join(result.advice),
    )


def _pose(result: OverlapResult, view: int) -> Check:
    camera = result.cameras[view]
    verdict = _VERDICTS[camera.verdict]
    passes, fails = result.limits.shift
    found = f"out of place by {1e3 * camera.shift:.1f} mm and {camera.rotation_degrees:.2f} degrees"
    if verdict is not Verdict.PASS and not _is_certain(camera, result.limits):
        verdict, found = Verdict.WARN, f"not measurable: {'; '.join(camera.unmeasurable) or found}"
    return Check(
        name="view_pose",
        verdict=verdict,
        found=found,
        value=None if found.startswith("not measurable") else camera.shift,
        threshold=passes,
        fails_at=fails,
        unit="m",
        advice="" if verdict is Verdict.PASS else _advice(result, camera),
        view=view,
    )


def _is_certain(camera: CameraOverlap, limits: OverlapLimits) -> bool:
    """Whether the camera is out of place by more than may pass, even when it is off by two standard deviations."""
    shift = camera.shift - 2 * camera.shift_sigma
    turn = camera.rotation_degrees - 2 * camera.rotation_sigma_degrees
    return shift > limits.shift[0] or turn > limits.rotation_degrees[0]


def _advice(result: OverlapResult, camera: CameraOverlap) -> str:
    if not _is_certain(camera, result.limits):
        return "put objects with upright sides where the cameras overlap"
    if camera.name in result.wrong:
        return f"recalibrate the camera of {camera.name}: the others agree without it"
    return "; ".join(result.advice)
