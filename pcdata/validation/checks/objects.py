"""How many objects are there, and how large? Numbers for trends, of clouds in which objects were told apart."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from pcdata.structures import METRE, PointCloud
from pcdata.transforms import describe_objects
from pcdata.validation.capture_check import register_check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.verdicts import Finding


@register_check(
    "How many objects are there, and how large are they?",
    findings={
        "object_count": (
            "objects in the cloud",
            "always",
            "never",
            "clouds that ClusterObjects went through; a count unlike the rest is a scene worth a look",
        ),
        "object_size": (
            "longest edge of the objects' boxes, the median of the cloud",
            "always",
            "never",
            "where a plane was found too; a size unlike the rest is a unit or a scale",
        ),
    },
    of=PointCloud,
)
def objects(cloud: PointCloud, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Count the objects, and measure them where they stand on a plane."""
    if cloud.num_clouds != 1 or "objects" not in cloud.meta[0]:
        return []
    count = len(cloud.meta[0]["objects"])
    found = [Finding(name="object_count", value=float(count), found=f"{count} objects")]
    if count and cloud.labels is not None and cloud.meta[0].get("planes") and cloud.unit == METRE:
        sizes = [float(one.size.max()) for one in describe_objects(cloud)]
        if sizes:
            told = f"{100 * min(sizes):.1f} to {100 * max(sizes):.1f} cm along the longest edge"
            found.append(Finding(name="object_size", value=median(sizes), unit="m", found=told))
    return found
