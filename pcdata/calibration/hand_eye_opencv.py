"""OpenCV's closed-form hand-eye solvers, to compare with."""

from __future__ import annotations

from typing import Any

import numpy as np

from pcdata.calibration.motions import Poses, pose_of
from pcdata.extras import require, why_missing

METHODS = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")


def opencv_solutions(
    holder_from_mount: Poses,  # (N, 4, 4)
    camera_from_target: Poses,  # (N, 4, 4)
) -> dict[str, Poses]:  # solver -> (4, 4) mount_from_camera
    """Return what each of OpenCV's solvers finds; none where OpenCV is absent, or fails on these poses.

    OpenCV calls its first argument ``gripper2base`` and means "base from gripper" with the camera on the gripper; for a
    camera that stands beside the robot the inverse goes there, which ``holder_from_mount`` is in both cases.
    """
    if why_missing("cv2") is not None:
        return {}
    cv2: Any = require("cv2")
    if not hasattr(cv2, "calibrateHandEye"):  # missing from the Python binding of 5.0
        return {}
    found = {}
    for method in METHODS:
        try:
            rotation, translation = cv2.calibrateHandEye(
                list(holder_from_mount[:, :3, :3]),
                list(holder_from_mount[:, :3, 3]),
                list(camera_from_target[:, :3, :3]),
                list(camera_from_target[:, :3, 3]),
                method=getattr(cv2, f"CALIB_HAND_EYE_{method}"),
            )
        except cv2.error:
            continue
        solution = pose_of(np.asarray(rotation), np.asarray(translation).ravel())
        if np.isfinite(solution).all() and abs(np.linalg.det(solution[:3, :3]) - 1) < 1e-3:
            found[f"OpenCV {method.capitalize()}"] = solution
    return found
