"""Does a cloud hold points so far away that they alone set its extent?"""

from __future__ import annotations

from collections.abc import Sequence

from pcdata.structures import PointCloud
from pcdata.validation.capture_check import register_check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.verdicts import Finding, graded


@register_check(
    "Does a cloud hold points so far away that they alone set its extent?",
    findings={
        "extent": (
            "the farthest point's distance from the middle (the median of x, y and z) / that within which 99 % lie",
            "{0.extent[0]:g}",
            "above {0.extent[1]:g}",
            "a model that scales clouds by their extent sees the rest at 1/number of its size; no depth camera's range "
            "spans 1 to 100",
        )
    },
    of=PointCloud,
)
def strays(cloud: PointCloud, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Judge the extent of a cloud, which one stray point can set."""
    if cloud.num_points < 2:
        return []
    points = cloud.points.double()  # squares of float32 may be infinite
    distances = (points - points.median(0).values).norm(dim=1)
    usual = float(distances.kthvalue(len(distances) - len(distances) // 100).values)
    farthest, where = distances.max(0)
    beyond = int((distances > limits.extent[0] * usual).sum())
    place = ", ".join(f"{float(value):.3g}" for value in points[where])
    return [
        graded(
            "extent",
            float(farthest) / usual if usual else 1.0,
            limits.extent,
            found=f"99 % lie within {usual:.3g} {cloud.unit} of the middle, the farthest point at "
            f"{float(farthest):.3g}: ({place}); {beyond} lie beyond {limits.extent[0]:g} times that",
            advice="RemoveStatisticalOutliers or CropWorkspace takes strays away; look where they come from",
        )
    ]
