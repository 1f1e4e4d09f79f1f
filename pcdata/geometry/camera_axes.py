"""Which way the axes of a camera point, by the names of those who have them so: from OpenCV's axes to theirs.

Source: OpenCV, calib3d; MuJoCo, XML reference ``camera`` (looks along -z, +x right, +y up); Blender and USD cameras the
same; PyRep, ``VisionSensor`` (focal lengths below 0: x left, y up, z forward); SAPIEN, ``RenderCameraComponent`` and
ROS REP 103 (x forward, y left, z up).
"""

from __future__ import annotations

import torch
from torch import Tensor


def _axes(*columns: tuple[int, int, int]) -> Tensor:
    """Return (4, 4) float64: columns are OpenCV's right, down and forward in the axes of another."""
    matrix = torch.eye(4, dtype=torch.float64, device="cpu")
    matrix[:3, :3] = torch.tensor(columns, dtype=torch.float64, device="cpu").T
    return matrix


# A pose times its row is the pose of a camera with OpenCV's axes: x right, y down, z forward.
CAMERA_AXES: dict[str, Tensor] = {
    "opencv": _axes((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    # x right, y up, z backwards: Blender, MuJoCo, Isaac Sim (USD) as well
    "opengl": _axes((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    # x left, y up, z forward; it states focal lengths below 0
    "coppeliasim": _axes((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    # x forward, y left, z up: camera poses of SAPIEN, Isaac Sim (world axes), frames of ROS that are not optical
    "body": _axes((0, -1, 0), (0, 0, -1), (1, 0, 0)),
}
