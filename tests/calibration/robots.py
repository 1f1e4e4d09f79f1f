"""A simulated robot: true placements, poses before a board, and what a noisy camera makes of it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pcdata.calibration import RobotPoses, locate_board
from pcdata.geometry import rigid
from pcdata.rng import seeded
from tests.calibration.boards import CAMERA, board_pose, corner_view


def placement(seed: int, translation: tuple[float, float, float]) -> Tensor:
    quaternion = torch.randn(4, generator=seeded(seed), dtype=torch.float64)
    return rigid.from_rotation_translation(
        rigid.rotation_from_quaternion(quaternion), torch.tensor(translation, dtype=torch.float64)
    )


MOUNT_FROM_CAMERA = placement(1, (0.05, -0.03, 0.08))
HOLDER_FROM_TARGET = placement(2, (0.5, 0.1, 0.02))


def camera_poses(count: int, seed: int = 0, *, degrees: float = 35.0) -> Tensor:
    """camera_from_target (N, 4, 4): 0.4 to 0.6 m away, turned by up to ``degrees`` about each axis."""
    generator = seeded(seed)
    poses = []
    for _ in range(count):
        tilt_x, tilt_y, roll = (degrees * (2 * torch.rand(3, generator=generator) - 1)).tolist()
        distance = 0.4 + 0.2 * float(torch.rand(1, generator=generator))
        aside = (100 * (torch.rand(2, generator=generator) - 0.5)).tolist()
        pose = board_pose(tilt_x, tilt_y, distance, aside=(aside[0], aside[1]))
        poses.append(about_axis((0, 0, 1), roll) @ pose)
    return torch.stack(poses)


def about_axis(axis: tuple[float, float, float], degrees: float) -> Tensor:
    """(4, 4) rotation about an axis through the origin."""
    unit = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    turn = rigid.rotation_about_axis(unit, torch.tensor(math.radians(degrees)))
    return rigid.from_rotation_translation(turn, torch.zeros(3, dtype=torch.float64))


def robot_poses(
    camera_from_target: Tensor,
    *,
    setup: str = "eye-in-hand",
    noise: float = 0.0,  # pixels on the corners of the board; 0 = the exact poses
    seed: int = 0,
) -> RobotPoses:
    """What robot and camera report at these true camera poses."""
    holder_from_mount = (
        HOLDER_FROM_TARGET @ rigid.invert_rigid(camera_from_target) @ rigid.invert_rigid(MOUNT_FROM_CAMERA)
    )
    seen = camera_from_target
    if noise > 0:
        views = [corner_view(pose, noise=noise, seed=1000 * seed + n) for n, pose in enumerate(camera_from_target)]
        seen = torch.stack([locate_board(view, CAMERA)[0] for view in views])
    return RobotPoses(
        names=tuple(f"pose{n:02d}" for n in range(len(seen))),
        base_from_gripper=holder_from_mount if setup == "eye-in-hand" else rigid.invert_rigid(holder_from_mount),
        camera_from_target=seen,
    )


def apart(a: Tensor, b: Tensor) -> tuple[float, float]:
    """Distance in millimetres and angle in degrees between two poses."""
    difference = rigid.invert_rigid(a) @ b
    sine = torch.linalg.matrix_norm(difference[:3, :3] - torch.eye(3, dtype=torch.float64)) / (2 * 2**0.5)
    return 1000 * float(difference[:3, 3].norm()), math.degrees(2 * math.asin(min(1.0, float(sine))))
