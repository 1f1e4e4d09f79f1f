"""Does a cloud hold pixels without depth, or padding, as points at the origin?"""

from __future__ import annotations

from collections.abc import Sequence

from pcdata.structures import PointCloud
from pcdata.validation.capture_check import register_check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.verdicts import Finding, graded


@register_check(
    "Does a cloud hold pixels without depth, or padding, as points at the origin?",
    findings={
        "at_origin": (
            "points at exactly (0, 0, 0) / all points",
            "{0.at_origin[0]:.1%}",
            "above {0.at_origin[1]:.0%}",
            "pixels without depth become this point where nobody drops them, and so does padding with zeros; of a "
            "surface a voxel or two may lie there",
        )
    },
    of=PointCloud,
)
def at_origin(cloud: PointCloud, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Judge the share of points that are no measurement."""
    if not cloud.num_points:
        return []
    count = int((cloud.points == 0).all(1).sum())
    return [
        graded(
            "at_origin",
            count / cloud.num_points,
            limits.at_origin,
            found=f"{count:,} of {cloud.num_points:,} points are exactly (0, 0, 0)",
            advice="drop them: they are pixels without depth, or padding, of the program that wrote the cloud",
        )
    ]
