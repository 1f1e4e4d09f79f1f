"""Depth, poses and calibrations made in memory are held to metres as files are."""

from __future__ import annotations

import pytest
import torch

from pcdata.calibration import RobotPoses
from pcdata.errors import CalibrationError, PoseError, UnitError
from pcdata.structures import Calibration, Camera, DepthFrame
from pcdata.validation import validate_frame
from pcdata.verdicts import Verdict

CAMERA = Camera.pinhole(fx=50, fy=50, cx=19.5, cy=14.5, size=(30, 40))


def at(distance: float) -> torch.Tensor:
    return torch.full((1, 30, 40), distance)


def moved(length: float) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = length
    return pose


def test_depth_in_millimetres_is_refused_with_the_factor() -> None:
    with pytest.raises(UnitError, match=r"half of the depth is beyond 812; .* multiply it by 0\.001 if .* millimetres"):
        DepthFrame(depth=at(812.0), camera=CAMERA)
    assert float(DepthFrame(depth=at(812.0) * 0.001, camera=CAMERA).depth.max()) == pytest.approx(0.812)


def test_a_hall_and_a_few_far_readings_are_no_millimetres() -> None:
    depth = at(60.0)
    depth[0, :5] = 400.0
    assert DepthFrame(depth=depth, camera=CAMERA).num_views == 1
    assert DepthFrame(depth=at(0.0), camera=CAMERA).num_views == 1


def test_a_pose_of_hundreds_of_metres_is_asked_about() -> None:
    frame = DepthFrame(depth=at(0.8), camera=CAMERA, world_from_camera=moved(812.0)[None], frame_id="base")
    check = next(one for one in validate_frame(frame) if one.name == "pose")
    assert check.verdict is Verdict.WARN
    assert "millimetres (0.812 m)" in check.advice


def test_a_baseline_in_millimetres_is_refused_in_memory_too() -> None:
    with pytest.raises(PoseError, match="55 m long; is it in millimetres"):
        Calibration(cameras={"left": CAMERA, "right": CAMERA}, transforms={"left_from_right": moved(55.0)})


def test_robot_poses_in_millimetres_are_refused_in_memory_too() -> None:
    poses = torch.stack([moved(400.0), moved(410.0)])
    with pytest.raises(CalibrationError, match="410 m long; is it in millimetres"):
        RobotPoses(names=("a", "b"), base_from_gripper=poses, camera_from_target=torch.stack([moved(0.4), moved(0.5)]))
