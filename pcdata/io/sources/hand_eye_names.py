"""Folders of robot poses that calibrate a camera, told by the names of their files; they hold no captures."""

from __future__ import annotations

import re
from pathlib import Path

from pcdata.errors import CaptureError
from pcdata.io.sources.listing import entries, has_file, is_folder

VISP, ROBOT_CAL_TOOLS, MOVEIT = "ViSP", "robot_cal_tools", "MoveIt Calibration"
POSE_LIST, MOVEIT_FILE = "cal_data.yaml", "pose_samples.json"
# The end effector in the robot's reference frame, as ViSP's tools save it with the image of the same number.
VISP_POSE = re.compile(r"(?P<start>.*)pose_[rf]Pe_(?P<number>\d+)\.ya?ml")


def hand_eye_tool(path: Path) -> str:
    """Return the name of the tool that saved the poses in a folder, or in a file; "" = these are no such poses."""
    if not is_folder(path):
        return MOVEIT if path.name == MOVEIT_FILE else ""
    if has_file(path / POSE_LIST):
        return ROBOT_CAL_TOOLS
    if has_file(path / MOVEIT_FILE):
        return MOVEIT
    try:
        return VISP if any(VISP_POSE.fullmatch(entry.name) for entry in entries(path)) else ""
    except CaptureError:
        return ""


def hand_eye_folders(path: Path) -> list[Path]:
    """Return the path itself where it is such a set, or the folders in it that are."""
    if hand_eye_tool(path):
        return [path]
    if not is_folder(path):
        return []
    try:
        return [entry for entry in entries(path) if is_folder(entry) and hand_eye_tool(entry)]
    except CaptureError:
        return []
