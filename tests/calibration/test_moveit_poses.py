"""What MoveIt Calibration saves is read as robot and target poses, and calibrates the camera beside the robot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pcdata.calibration import RobotPoses, calibrate_hand_eye, read_robot_poses
from pcdata.errors import CalibrationError
from tests.calibration.robots import camera_poses, robot_poses


def test_pairs_of_matrices_are_robot_and_target_poses(tmp_path: Path) -> None:
    poses = robot_poses(camera_poses(5), setup="eye-in-hand")
    pairs = [[a.tolist(), b.tolist()] for a, b in zip(poses.base_from_gripper, poses.camera_from_target)]
    (tmp_path / "pose_samples.json").write_text(json.dumps(pairs))
    read = read_robot_poses(tmp_path / "pose_samples.json")
    assert read.names == ("0", "1", "2", "3", "4")
    assert np.array_equal(read.base_from_gripper.numpy(), poses.base_from_gripper.numpy())
    assert np.array_equal(read.camera_from_target.numpy(), poses.camera_from_target.numpy())


@pytest.mark.parametrize(
    ("saved", "words"),
    [
        ([], "holds no pose"),
        ([[np.eye(4).tolist()]], "sample 0: must be a pair"),
        ([[np.eye(4).tolist(), np.eye(3).tolist()]], "sample 0: camera_from_target"),
        ([[np.eye(4).tolist(), (2 * np.eye(4)).tolist()]], "sample 0: camera_from_target"),
        ([3], "sample 0"),
    ],
)
def test_lists_that_are_no_pairs_of_poses_are_refused(tmp_path: Path, saved: Any, words: str) -> None:
    (tmp_path / "pose_samples.json").write_text(json.dumps(saved))
    with pytest.raises(CalibrationError, match=words):
        read_robot_poses(tmp_path / "pose_samples.json")


def test_a_real_robots_samples_fit_a_camera_beside_it(test_data: Path) -> None:
    poses = read_robot_poses(test_data / "moveit_hand_eye" / "pose_samples.json")
    saved = json.loads((test_data / "moveit_hand_eye" / "pose_samples.json").read_text())
    assert len(poses.names) == len(saved)
    assert np.array_equal(poses.base_from_gripper.numpy(), np.array([pair[0] for pair in saved]))
    some = RobotPoses(
        names=poses.names[:12],
        base_from_gripper=poses.base_from_gripper[:12],
        camera_from_target=poses.camera_from_target[:12],
    )
    beside = calibrate_hand_eye(some, setup="eye-to-hand")
    assert np.median([*beside.translation_residuals.values()]) < 0.006
