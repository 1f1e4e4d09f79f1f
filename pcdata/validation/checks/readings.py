"""Are the numbers lengths in metres, of the workspace, and not clipped?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from pcdata.functional.depth.stored_depth import MARKS
from pcdata.structures import DepthFrame, PointCloud
from pcdata.threads import in_threads
from pcdata.validation.capture_check import register_check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.checks.depth_unit import depth_unit_check
from pcdata.validation.measures.extremes import pile_at_extreme
from pcdata.verdicts import Finding, graded

_SAMPLES = 1 << 17  # readings looked at: shares are then known to 0.2 %

CAMERA = "camera"  # frames of clouds whose z is depth begin so


@register_check(
    "Are the numbers lengths in metres, of the workspace, and not clipped?",
    findings={
        "depth_unit": (
            "median depth",
            "one unit alone fits the numbers (probability 0.94) and the median is up to twice beyond the workspace, "
            "or, where none is stated, beyond the usual {0.expected[0]:g} to {0.expected[1]:g} m",
            "the declared unit has a probability below 0.02",
            "every usual unit (1/1000, 1/4000, 1/5000, 1/10000, 1/256 m, metres, rotated bits, swapped bytes, ...) is "
            "tried on the numbers as stored: how usual it is, distance, noise and disparity steps for the focal "
            "length, divisors of the numbers, smoothness. Between the two it warns and names all that fit; "
            "`--workspace` around a measured distance or `--sensor` tells them apart. No unit is known from depth "
            "alone: a scene without noise may fit several",
        ),
        "workspace_fraction": (
            "readings inside the workspace / all readings",
            "{0.workspace_fraction[0]:.0%}",
            "below {0.workspace_fraction[1]:.1%}",
            "most of what is seen should be what the task is about. Judged only where that is stated, with "
            "`--workspace` or `--sensor`: a room is no worse than a table",
        ),
        "saturation": (
            "readings exactly at the highest or lowest depth, where they outnumber those within 2 % of it",
            "{0.saturation[0]:.1%}",
            "above {0.saturation[1]:.0%}",
            "a surface that ends there has fewer readings at the very end than before it. 65535, 4095 and 32767 are "
            "named",
        ),
    },
    of=(DepthFrame, PointCloud),
)
def readings(capture: DepthFrame | PointCloud, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Judge every view; of a cloud z in a camera's frame, elsewhere the distance from the viewpoint."""
    if isinstance(capture, PointCloud):
        return _judged(_depth_of(capture), limits)
    frame = capture

    def judged(view: int) -> list[Finding]:
        focal = float(frame.camera.intrinsics[view, 0, 0])
        return _judged(frame.depth[view], limits, facts=frame.provenance, focal=focal, view=view)

    return [finding for found in in_threads(judged, range(frame.num_views)) for finding in found]


def _depth_of(cloud: PointCloud) -> Tensor:
    if cloud.frame_id.startswith(CAMERA):
        return cloud.points[:, 2].abs()
    origin = torch.zeros(3, dtype=torch.float32, device=cloud.device)
    viewpoint = origin if cloud.viewpoint is None else cloud.viewpoint[0]
    return (cloud.points - viewpoint).norm(dim=1)


def _judged(
    depth: Tensor,  # (H, W), or (N,) where there is no image; metres, 0 = no reading
    limits: CaptureLimits,
    *,
    facts: Mapping[str, Any] | None = None,  # provenance: the unit and the order of bits of the file, where known
    focal: float | None = None,  # pixels
    view: int | None = None,
) -> list[Finding]:
    """Judge the unit, the range and the ends of the range of the readings."""
    flat = depth.flatten()
    flat = flat[:: max(1, len(flat) // _SAMPLES)]
    readings = flat[flat > 0]
    if not len(readings):
        return []  # coverage has said so
    return [
        depth_unit_check(depth if depth.ndim == 2 else depth[None], limits, facts or {}, focal=focal, view=view),
        *([] if limits.workspace is None else [_range(readings, limits, limits.workspace, view)]),
        _saturation(readings, limits, (facts or {}).get("metres_per_unit"), view),
    ]


def _range(readings: Tensor, limits: CaptureLimits, workspace: tuple[float, float], view: int | None) -> Finding:
    near, far = workspace
    one_percent = len(readings) // 100
    low = float(readings.kthvalue(1 + one_percent).values)
    high = float(readings.kthvalue(len(readings) - one_percent).values)
    fraction = float(((readings >= near) & (readings <= far)).float().mean())
    return graded(
        "workspace_fraction",
        fraction,
        limits=limits.workspace_fraction,
        at_least=True,
        found=f"98 % of the readings lie between {low:.3g} and {high:.3g} m",
        advice="move the camera, or say how far this task's scene is with --workspace NEAR FAR, in place of "
        f"{near:g} to {far:g} m",
        view=view,
    )


def _saturation(readings: Tensor, limits: CaptureLimits, metres_per_unit: float | None, view: int | None) -> Finding:
    piles = [pile for end in ("far", "near") if (pile := pile_at_extreme(readings, end=end)) is not None]
    value, fraction = max(piles, key=lambda pile: pile[1], default=(0.0, 0.0))
    found, advice = "no pile of readings at either end of the range", ""
    if fraction:
        stored = None if metres_per_unit is None else round(value / metres_per_unit)
        found = f"{100 * fraction:.3g} % of the readings are exactly {value:.5g} m"
        advice = "clipped at the end of the sensor's range: store 0 there instead"
        if stored is not None and metres_per_unit != 1.0:
            found += f", stored as {stored}" + (f", {MARKS[stored]}" if stored in MARKS else "")
            say = (
                f'say so: --invalid-values {stored}, or "invalid_values": [{stored}] in intrinsics.json, in Python '
                f"open_source(invalid_values=[{stored}])"
            )
            if stored in MARKS:
                advice = f"{stored} marks 'no reading' in some formats: {say}"
            else:
                advice += f"; if {stored} marks 'no reading', {say}"
    return graded(
        "saturation",
        fraction,
        limits=limits.saturation,
        found=found,
        advice=advice,
        view=view,
    )
