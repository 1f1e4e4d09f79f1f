"""The options of writing captures as a LeRobot dataset, checked before anything is written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import ConfigError
from pcdata.io.writers.lerobot_camera_files import ColorStorage, DepthStorage
from pcdata.io.writers.writer import Writer
from pcdata.structures.pose_rows import checked_pose_layout


@dataclass(frozen=True, kw_only=True)
class LeRobotOptions(Writer):
    """How captures become a LeRobot dataset.

    Args:
        depth: "ffv1": lossless 16-bit videos beside the features; "image": 16-bit PNG in the rows, which the package
            lerobot reads too; "array": float32 metres in the rows; "auto": ffv1 where the depth of the first capture
            is whole units, which those of all others must be too, else array.
        metres_per_unit: of stored depth, which is rounded to it; None = the unit that the first capture is whole in.
        color: "video": H.264, whose loss shows; "image": PNG; "none": left out.
        fps: steps in a second; None = of the times of the episodes, 10 where there are none.
        state: signals that ``observation.state`` repeats in one row, as policies take them.
        action: the same of ``action``, where no signal is called so.
        poses: how ``state`` and ``action`` write poses: xyz_rot6d_rows, xyz_quat_xyzw or another layout of a row
            (docs/signals.md); "" = as they were recorded, and those that are 4x4 as xyz_rot6d_rows.
        points: rows of ``observation.pointcloud``, the capture's points in the frame of its poses; 0 = none.
        registered_to: what to say of whose pixels depth has; None = of color, where captures have that.
        robot_type: the name of the robot.
    """

    depth: DepthStorage = "auto"
    metres_per_unit: float | None = None
    color: ColorStorage = "video"
    fps: float | None = None
    state: Sequence[str] | str = ()
    action: Sequence[str] | str = ()
    poses: str = ""
    points: int = 0
    registered_to: str | None = None
    robot_type: str | None = None

    def __post_init__(self) -> None:
        for option, value, known in (
            ("depth", self.depth, get_args(DepthStorage)),
            ("color", self.color, get_args(ColorStorage)),
        ):
            if value not in known:
                raise ConfigError(f"lerobot: {option} must be one of {', '.join(known)}, got {value!r:.60}")
        if self.metres_per_unit is not None:
            check_metres_per_unit("lerobot", self.metres_per_unit)
        if self.depth == "array" and self.metres_per_unit is not None:
            raise ConfigError("lerobot: depth=array stores metres as they are; leave out metres_per_unit")
        fps: Any = self.fps
        if fps is not None and not (isinstance(fps, (int, float)) and 1 <= fps <= 1000):
            raise ConfigError(f"lerobot: fps must be steps in a second, 1 to 1000, got {fps!r:.60}")
        if self.poses != "":
            checked_pose_layout("lerobot: poses", self.poses)
            if not self.state and not self.action:
                raise ConfigError("lerobot: poses says how state and action write poses; give state=NAME,NAME too")
        points: Any = self.points
        if isinstance(points, bool) or not isinstance(points, int) or not 0 <= points < 1 << 24:
            raise ConfigError(f"lerobot: points must be a whole number from 0, got {points!r:.60}")
        for option, text in (("registered_to", self.registered_to), ("robot_type", self.robot_type)):
            if text is not None and not (isinstance(text, str) and text):
                raise ConfigError(f"lerobot: {option} must be a text, got {text!r:.60}")
