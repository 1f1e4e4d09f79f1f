"""What RemovePlane warns of: tables that lean, and planes about which no table could be measured."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

from pcdata.errors import PcdataWarning
from pcdata.structures import CAMERA_FRAME, PointCloud
from pcdata.transforms.base import sample_name

# Radians: from here on a plane is rather a wall than a table that a pose is wrong about.
_WALL = math.radians(60)


class TiltedPlaneWarning(PcdataWarning):
    """A table that is not level: its pose, the stated up, or the choice of the plane is wrong."""


class UnmeasuredTableWarning(PcdataWarning):
    """A plane about which no table could be measured, so nothing was cut from it."""


def warn_of_no_table(cloud: PointCloud, b: int, distance: float) -> None:
    """Say that the table could not be measured."""
    warnings.warn(
        f"RemovePlane: cloud {b}{sample_name(cloud, b)}: cut='measured' found no table to measure: what lies about "
        "the plane goes on through it, or is noisier than a depth camera is, so none of it was removed; crop to "
        "the table before, say which plane it is by up and max_tilt, or cut='slab' to remove all that is closer "
        f"than distance={distance:g}",
        UnmeasuredTableWarning,
        stacklevel=2,
    )


def warn_of_tilt(cloud: PointCloud, b: int, tilt: float, up: Sequence[float], frame: str | None) -> None:
    """Say by how much a table leans from ``up`` in ``frame``, in radians, and what that mostly comes from."""
    turned = [step["step"] for step in cloud.history[b] if step["step"].startswith("Random")]
    if tilt > _WALL:
        cause = (
            f"it is a wall or the side of a box, or up={up} is not up in frame {frame!r} (cameras have y down); give "
            "max_tilt to look for a level plane, or correct up"
        )
    elif turned:
        cause = f"{', '.join(turned)} before it turned the cloud; put RemovePlane before random steps"
    elif cloud.frame_id == CAMERA_FRAME:
        cause = (
            f"the camera looks down at another angle than up={up} says; bring the cloud into a level frame by ToFrame, "
            "or correct up"
        )
    else:
        cause = (
            f"the pose of the camera in {frame!r} is off by as much (check it: pcdata calib, pcdata validate), or the "
            "table does lean; raise tilt_alarm if it does"
        )
    warnings.warn(
        f"RemovePlane: cloud {b}{sample_name(cloud, b)}: the plane is tilted by {math.degrees(tilt):.1f} degrees from "
        f"up; likely {cause}",
        TiltedPlaneWarning,
        stacklevel=2,
    )
