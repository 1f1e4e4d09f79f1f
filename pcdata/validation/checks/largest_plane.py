"""How does the largest plane lie, and how noisy is depth on it? Numbers for trends; none of them is right or wrong."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from pcdata.structures import DepthFrame
from pcdata.validation.capture_check import register_check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.measures.plane_bend import LEAST_SHARE, MOST_SPREAD, PlaneBend, plane_bends
from pcdata.verdicts import Finding

_PLANE = 0.3  # of a power of the rays' lengths: what is bent more is no plane as depth is read


@register_check(
    "How does the largest plane lie, and how noisy is depth on it?",
    findings={
        "plane_noise": (
            "standard deviation of a reading along the optical axis, on the largest plane, from second differences",
            "always",
            "never",
            "it grows with the distance, and with dirt, light and age of the camera: for trends and for choosing noise",
        ),
        "plane_height": (
            "height (z) of the middle of the largest plane in the frame that the poses lead to; without poses its "
            "distance from the camera",
            "always",
            "never",
            "a table stays where it is: a step in it is a moved table, or a moved camera",
        ),
        "plane_tilt": (
            "angle between the largest plane and the horizontal (x, y) of that frame; without poses the image plane",
            "always",
            "never",
            "as plane_height",
        ),
    },
)
def largest_plane(frame: DepthFrame, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Tell it of every view in which one plane holds enough of the readings."""
    found: list[Finding] = []
    for view, bend in enumerate(plane_bends(frame)):
        if bend is not None and bend.share >= LEAST_SHARE and bend.spread <= MOST_SPREAD and abs(bend.power) <= _PLANE:
            found += _told(frame, bend, view)
    return found


def _told(frame: DepthFrame, bend: PlaneBend, view: int) -> Iterator[Finding]:
    normal, middle = np.array(bend.plane), np.array(bend.middle)
    length = float(np.linalg.norm(normal))
    sigma = bend.noise * bend.middle[2]
    share = f"the largest plane holds {bend.share:.0%} of the readings"
    found = f"{share}; they scatter by {1e3 * sigma:.2g} mm at {bend.middle[2]:.2f} m"
    yield Finding(name="plane_noise", value=sigma, unit="m", found=found, view=view)
    where, height, upward = "from the camera", 1 / length, normal[2] / length
    if frame.world_from_camera is not None and frame.frame_id is not None:
        pose = frame.world_from_camera[view].cpu().double().numpy()
        where = f"in {frame.frame_id!r}"
        height = float(pose[2, :3] @ middle + pose[2, 3])
        upward = float(pose[2, :3] @ normal) / length
    tilt = math.degrees(math.acos(min(abs(upward), 1.0)))
    found = f"{share}; its middle lies {height:.4f} m {where}, tilted by {tilt:.2f} degrees"
    yield Finding(name="plane_height", value=height, unit="m", found=found, view=view)
    yield Finding(name="plane_tilt", value=tilt, unit="degrees", found=found, view=view)
