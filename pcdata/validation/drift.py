"""Did a camera move? Told from the still background of its depth, against the begin of a recording or another one.

Captures in a row are averaged, and what each camera sees then is aligned with what it saw first, point to plane with
robust weights: things that move are few of the samples, and what they say is unlike the rest. Nothing about a camera's
surroundings has to be known, and no color is looked at.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.alignment.surfaces import Surface, depth_surface
from pcdata.alignment.view_alignment import align_views
from pcdata.errors import CaptureError, ConfigError, DTypeError, PcdataError
from pcdata.functional.depth.average import average_depth
from pcdata.io.sources.capture_source import CaptureSource, checked_ids
from pcdata.structures import DepthFrame
from pcdata.threads import torch_on_one_thread
from pcdata.validation.drift_result import (
    MOVING,
    RAMP,
    STEP,
    STILL,
    UNKNOWN,
    CameraDrift,
    DriftLimits,
    DriftPoint,
    DriftResult,
)
from pcdata.validation.overlap import judge_alignment
from pcdata.validation.overlap_result import CameraOverlap
from pcdata.validation.view_names import view_names
from pcdata.verdicts import Verdict

_MAX_SAMPLES = 4000  # of a view, as overlap takes
_SAME = torch.eye(4, dtype=torch.float64, device="cpu").repeat(2, 1, 1)  # then and now, both in its frame
_CHANGED = 0.03  # metres and share of depth: what changed more than this, beyond what a drift does, is another thing
_FEWEST = 0.3  # of the samples that must meet the first surface; fewer is another scene, or a moving camera
_FAR = 0.05  # metres from one window to the next: no mount slips so, a hand does


@torch_on_one_thread()
def measure_drift(
    source: CaptureSource,
    *,
    reference: CaptureSource | None = None,
    window: int = 5,
    num_windows: int = 40,
    limits: DriftLimits | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> DriftResult:
    """Say for every camera whether it is where it was, how far it is off, and since when.

    Args:
        source: captures in order, depth images of one or several views.
        reference: where the cameras were at first; None = the first captures of the source itself.
        window: captures in a row that are averaged: noise falls, and so does what moves quickly.
        num_windows: windows spread over the recording; memory does not grow with its length.
        limits: how far is too far; None = the defaults, which tell 2 mm and 0.2 degrees.
        progress: told (windows done, all, which capture).

    Raises:
        CaptureError: too few captures, or other cameras in some of them.
        DTypeError: captures that are no depth images.
        ConfigError: ``window`` or ``num_windows`` is too small.
    """
    if window < 1 or num_windows < 2:
        raise ConfigError(
            f"measure_drift: window must be 1 or more and num_windows 2 or more, got {window}, {num_windows}"
        )
    checked_ids("measure_drift", source)
    limits = limits or DriftLimits()
    starts = _starts(len(source.ids), window, num_windows, own=reference is None)
    first = _window(source if reference is None else reference, 0, window)
    surfaces = [_surface(first, view, first.depth[view]) for view in range(first.num_views)]
    found: list[list[tuple[DriftPoint, tuple[str, ...]]]] = [[] for _ in surfaces]
    carried = [False] * len(surfaces)
    for number, start in enumerate(starts):
        now = _window(source, start, window)
        _check_same(first, now)
        ids = source.ids[start], source.ids[min(start + window, len(source.ids)) - 1]
        for view, surface in enumerate(surfaces):
            carried[view] = carried[view] or _was_carried(first, now, view)
            found[view].append(_point(first, now, view, surface, ids, limits))
        if progress is not None:
            progress(number + 1, len(starts), ids[0])
    names = view_names(first.provenance, first.num_views)
    # Windows that both lie beside a third, into which a step may have fallen.
    apart = max(2, -(-2 * window // max(1, (starts[-1] - starts[0]) // max(1, len(starts) - 1))))
    cameras = (_judged(name, own, moved, apart) for name, own, moved in zip(names, found, carried))
    return DriftResult(cameras=tuple(cameras), limits=limits)


def _starts(count: int, window: int, num_windows: int, *, own: bool) -> list[int]:
    begin = window if own else 0
    last = count - window
    if last < begin:
        needed = begin + window
        raise CaptureError(
            f"measure_drift: needs {needed} captures or more ({window} are averaged"
            f"{', the first are what the others are compared with' if own else ''}), the source has {count}; give a "
            "longer recording, or a smaller window (--window N)"
        )
    return np.unique(np.linspace(begin, last, min(num_windows, last - begin + 1)).round().astype(int)).tolist()


def _window(source: CaptureSource, start: int, window: int) -> DepthFrame:
    """Return the average of captures in a row."""
    frames: list[DepthFrame] = []
    for sample_id in source.ids[start : start + window]:
        frame = source.load(sample_id)
        if not isinstance(frame, DepthFrame):
            raise DTypeError(f"measure_drift: {sample_id!r} is no depth image but a {type(frame).__name__}")
        if frames:
            _check_same(frames[0], frame)
        frames.append(frame)
    least = max(1, len(frames) // 2)
    average = average_depth(torch.stack([frame.depth for frame in frames]), min_count=least)
    return replace(frames[0], depth=average.depth, colors=None, confidence=None, labels=None, mask=None)


def _check_same(first: DepthFrame, other: DepthFrame) -> None:
    if (first.num_views, first.size) != (other.num_views, other.size):
        raise CaptureError(
            f"measure_drift: capture {other.sample_id!r} has {other.num_views} views of {other.size}, "
            f"{first.sample_id!r} has {first.num_views} of {first.size}; give one recording of one rig"
        )


def _surface(frame: DepthFrame, view: int, depth: Tensor) -> Surface:
    distortion = None if frame.camera.distortion is None else frame.camera.distortion[view]
    return depth_surface(depth, frame.camera.intrinsics[view], distortion, max_samples=_MAX_SAMPLES)


def _was_carried(first: DepthFrame, now: DepthFrame, view: int) -> bool:
    """Whether the recording itself says that the camera is elsewhere: then it is meant to move."""
    if first.world_from_camera is None or now.world_from_camera is None or first.frame_id != now.frame_id:
        return False
    return not torch.allclose(first.world_from_camera[view], now.world_from_camera[view], rtol=0, atol=1e-4)


def _point(
    first: DepthFrame,
    now: DepthFrame,
    view: int,
    surface: Surface,
    ids: tuple[str, str],
    limits: DriftLimits,
) -> tuple[DriftPoint, tuple[str, ...]]:
    try:
        # What is far from where it was is another thing, or a person: of those that are left, few are.
        was, depth = first.depth[view], now.depth[view]
        background = (was > 0) & ((depth - was).abs() <= _CHANGED * (1 + was))
        seen = float((depth > 0).sum())
        kept = float(background.sum()) / max(seen, 1.0)
        current = _surface(now, view, torch.where(background, depth, torch.zeros_like(depth)))
        fit = align_views([[surface, current]], _SAME.to(depth.device))
        result = judge_alignment(fit, ("then", "now"), limits.overlap(), reference=0)
    except PcdataError:
        return _lost(ids, 0.0), ()
    camera = result.cameras[1]
    met = (len(one.row) / max(one.num_visible, 1) for one in fit.after)
    meeting = min(1.0, kept) * min(1.0, *met)
    if meeting < _FEWEST or math.isinf(camera.shift):
        return _lost(ids, meeting), ()
    return _told(camera, fit.motions[1], ids, meeting), camera.unmeasurable


def _told(camera: CameraOverlap, motion: Tensor, ids: tuple[str, str], meeting: float) -> DriftPoint:
    return DriftPoint(
        first=ids[0],
        last=ids[1],
        shift=camera.shift,
        shift_sigma=camera.measured_shift_sigma,
        rotation_degrees=camera.rotation_degrees,
        rotation_sigma_degrees=camera.measured_rotation_sigma_degrees,
        camera_shift=tuple(motion[:3, 3].tolist()),
        meeting=meeting,
        verdict=camera.verdict,
    )


def _lost(ids: tuple[str, str], meeting: float) -> DriftPoint:
    return DriftPoint(
        first=ids[0],
        last=ids[1],
        shift=math.nan,
        shift_sigma=math.nan,
        rotation_degrees=math.nan,
        rotation_sigma_degrees=math.nan,
        camera_shift=(math.nan,) * 3,
        meeting=meeting,
        verdict=Verdict.UNKNOWN,
    )


def _judged(name: str, found: Sequence[tuple[DriftPoint, tuple[str, ...]]], carried: bool, apart: int) -> CameraDrift:
    points = tuple(point for point, _ in found)
    places = np.array([point.camera_shift for point in points])
    known = np.isfinite(places[:, 0])
    verdict, since = _lasting(points)
    drift = CameraDrift(
        name=name,
        kind=UNKNOWN,
        shift=math.nan,
        rotation_degrees=math.nan,
        since="",
        unmeasurable=found[-1][1],
        points=points,
        verdict=Verdict.UNKNOWN,
    )
    if carried or _is_moving(places, known):
        return replace(drift, kind=MOVING)
    if not known.any():
        return drift
    if verdict.severity < Verdict.WARN.severity:
        good = [point for point, is_known in zip(points, known) if is_known]
        return replace(
            drift,
            kind=STILL,
            verdict=verdict,
            shift=float(np.median([point.shift for point in good])),
            rotation_degrees=float(np.median([point.rotation_degrees for point in good])),
        )
    out = [point for point, is_known in zip(points[since:], known[since:]) if is_known]
    kind = STEP if _is_step(points, known, apart) else RAMP
    tail = out if kind == STEP else out[-max(1, len(out) // 10) :]
    return replace(
        drift,
        kind=kind,
        verdict=verdict,
        since=points[since].first,
        shift=float(np.median([point.shift for point in tail])),
        rotation_degrees=float(np.median([point.rotation_degrees for point in tail])),
    )


def _lasting(points: Sequence[DriftPoint]) -> tuple[Verdict, int]:
    """Return the worst verdict that two windows in a row have, or the last one, and from where on it lasts."""
    severities = [point.verdict.severity for point in points]
    for verdict in (Verdict.FAIL, Verdict.WARN):
        bad = [severity >= verdict.severity for severity in severities]
        for place in range(len(bad)):
            if bad[place] and (place + 1 == len(bad) or bad[place + 1]):
                return verdict, place
    return (Verdict.UNKNOWN if Verdict.UNKNOWN.severity in severities else Verdict.PASS), 0


def _is_moving(places: NDArray[np.float64], known: NDArray[np.bool_]) -> bool:
    """Whether it is elsewhere again and again: most windows are lost, or far from the one before."""
    if len(places) < 3:
        return False
    jumps = np.linalg.norm(np.diff(places[known], axis=0), axis=1)
    return bool(known.mean() < 0.5 and len(places) > 3) or bool(len(jumps) and (jumps > _FAR).mean() > 0.5)


def _is_step(points: Sequence[DriftPoint], known: NDArray[np.bool_], apart: int) -> bool:
    """Whether more than half of the way was gone between two windows that are ``apart`` windows from each other."""
    sizes = [point.shift + math.radians(point.rotation_degrees) for point, one in zip(points, known) if one]
    track = np.array([*[0.0] * (apart - 1), *sizes])
    if len(sizes) <= 2 * apart:
        return True  # too few to tell a ramp
    return bool(np.abs(track[apart:] - track[:-apart]).max() > 0.6 * track.max())
