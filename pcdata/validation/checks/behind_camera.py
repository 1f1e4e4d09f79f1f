"""Does a cloud in a camera's frame lie before the camera?"""

from __future__ import annotations

from collections.abc import Sequence

from pcdata.structures import PointCloud
from pcdata.validation.capture_check import register_check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.checks.readings import CAMERA
from pcdata.verdicts import Finding, graded


@register_check(
    "Does a cloud in a camera's frame lie before the camera?",
    findings={"behind_camera": ("points with negative z / all points", "0", "above 1 %", "clouds in a camera's frame")},
    of=PointCloud,
)
def behind_camera(cloud: PointCloud, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Judge the share of points with a negative z, which no depth image can hold."""
    if not cloud.frame_id.startswith(CAMERA):
        return []
    fraction = float((cloud.points[:, 2] < 0).float().mean()) if cloud.num_points else 0.0
    return [
        graded(
            "behind_camera",
            fraction,
            (0.0, 0.01),
            found=f"{100 * fraction:.3g} % of the points have a negative z",
            advice="z points backwards (OpenGL axes), or the cloud is in another frame than the camera's: give "
            "frame_id",
        )
    ]
