"""Can the intrinsics belong to this image, and the poses to any camera?"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from pcdata.contracts.lengths import FARTHEST
from pcdata.structures import DepthFrame
from pcdata.validation.capture_check import register_check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.verdicts import Finding, Verdict, graded

_MAX_SKEWED = 1e-3  # of R R^T - I; more is refused where a frame is made


@register_check(
    "Can the intrinsics belong to this image?",
    findings={
        "principal_point": (
            "distance from the image's center / image size",
            "{0.principal_point[0]:.0%}",
            "above {0.principal_point[1]:.1%}",
            "lenses are mounted within 5 %; K of an image resized by 0.8 is off by 10 %: halfway. Names the size that "
            "K fits. Not for windows cut from an image",
        ),
        "field_of_view": (
            "degrees across the image",
            "{0.field_of_view[0]:g} to {0.field_of_view[1]:g}",
            "outside",
            "the range of depth cameras",
        ),
        "pixel_aspect": (
            "abs(fx / fy - 1)",
            "{0.pixel_aspect:.0%}",
            "never",
            "an image resized unevenly differs on purpose",
        ),
    },
)
def intrinsics(frame: DepthFrame, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Judge principal point, field of view and pixel shape; the first two only of uncropped images."""
    camera, checks = frame.camera, []
    for view, (k, off) in enumerate(zip(camera.intrinsics.tolist(), camera.off_center())):
        (fx, _, cx), (_, fy, cy), _ = k
        if not camera.is_window:
            checks += [
                _principal_point(off, cx, cy, camera.size, limits, view),
                _field_of_view(fx, cx, camera.size[1], limits, view),
            ]
        checks.append(
            graded(
                "pixel_aspect",
                abs(fx / fy - 1),
                limits=(limits.pixel_aspect, None),
                found=f"fx {fx:.1f}, fy {fy:.1f} pixels",
                advice="right only if the image was resized unevenly and K with it; else take the K of this resolution",
                view=view,
            )
        )
    return checks


@register_check(
    "Does the capture state all that its points need?",
    findings={
        "stated": (
            "parts of the calibration that its layout has a place for, and that are not there",
            "none",
            "any that these points need",
            "a reader that cannot do without one refuses the capture; where points would only be off, as by the "
            'distance between a depth and a color camera, it names the part in `provenance["missing"]`; what only '
            'other images of the capture need, in `provenance["not_needed"]`, which warns',
        )
    },
)
def stated(frame: DepthFrame, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Name what the reader missed; nothing where it missed nothing."""
    return [
        Finding(
            name="stated",
            verdict=verdict,
            found=str(missing).partition(";")[0],
            value=None,
            advice=str(missing).rpartition("; ")[2],
        )
        for key, verdict in (("missing", Verdict.FAIL), ("not_needed", Verdict.WARN))
        for missing in frame.provenance.get(key, ())
    ]


@register_check(
    "Can the poses belong to any camera?",
    findings={
        "pose": (
            "largest entry of R R^T - I",
            f"{_MAX_SKEWED:g}",
            "above",
            "mirrors, scales, transposed matrices and lost tracking fail where the capture is read",
        )
    },
)
def poses(frame: DepthFrame, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Judge how far they are from rigid; those that are not are refused before a frame exists."""
    if frame.world_from_camera is None:
        return []
    rotation = frame.world_from_camera[:, :3, :3]
    away = frame.world_from_camera[:, :3, 3].norm(dim=1).tolist()
    error = (rotation @ rotation.mT - torch.eye(3, dtype=rotation.dtype, device=rotation.device)).abs().amax((1, 2))
    return [
        _far_pose(far, frame.frame_id or "world", view)
        if far > FARTHEST and off <= _MAX_SKEWED
        else graded(
            "pose",
            float(off),
            limits=(_MAX_SKEWED, _MAX_SKEWED),
            found=f"R R^T differs from the identity by {float(off):.1g}",
            advice="write rotations with more digits, or make them orthonormal again",
            view=view,
        )
        for view, (off, far) in enumerate(zip(error, away))
    ]


def _principal_point(
    off: float, cx: float, cy: float, size: tuple[int, int], limits: CaptureLimits, view: int
) -> Finding:
    height, width = size
    return graded(
        "principal_point",
        off,
        limits=limits.principal_point,
        found=f"({cx:.1f}, {cy:.1f}) in an image of {width}x{height}",
        advice=f"such intrinsics belong to an image of about {2 * cx + 1:.0f}x{2 * cy + 1:.0f}: state this one's "
        f"(in Python of a resized image Camera.resized(({height}, {width})), of a cropped one Camera.cropped); if the "
        "camera itself cuts its images from those of the sensor (narrow modes of Azure Kinect and Femto), K is right: "
        "say is_window of it",
        view=view,
    )


def _field_of_view(fx: float, cx: float, width: int, limits: CaptureLimits, view: int) -> Finding:
    """The angle across the image through the principal point, without the lens distortion."""
    degrees = math.degrees(math.atan((cx + 0.5) / fx) + math.atan((width - 0.5 - cx) / fx))
    least, most = limits.field_of_view
    bound = least if degrees < math.sqrt(least * most) else most
    ok = least <= degrees <= most
    return Finding(
        name="field_of_view",
        verdict=Verdict.PASS if ok else Verdict.FAIL,
        found=f"{degrees:.0f} degrees across {width} pixels at fx {fx:.1f}",
        value=degrees,
        threshold=bound,
        fails_at=bound,
        unit="degrees",
        at_least=bound == least,
        advice="" if ok else "K belongs to another resolution, or fx is in other units than pixels (mm?)",
        view=view,
    )


def _far_pose(metres: float, frame_id: str, view: int) -> Finding:
    return Finding(
        name="pose",
        verdict=Verdict.WARN,
        found=f"the camera stands {metres:.4g} m from the origin of {frame_id!r}",
        value=None,
        advice=f"are translations in millimetres ({metres / 1000:.3g} m)? Write metres; right if it is that far",
        view=view,
    )
