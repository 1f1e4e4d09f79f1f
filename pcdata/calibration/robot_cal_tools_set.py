"""What ROS-Industrial's robot_cal_tools saves: a list of poses and images, each pose, the camera and the target.

Source: robot_cal_tools, rct_ros_tools: ``cal_data.yaml``, poses of the wrist in the robot's base (metres, quaternions
by name), ``camera_intr.yaml`` (a guess) and ``camera_intr_calibrated.yaml``, ``target.yaml`` (a plugin's name).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from pcdata.calibration.boards import Board, Charuco, dictionary_of_number
from pcdata.calibration.hand_eye_set import HandEyeSet, Size
from pcdata.errors import CalibrationError, CaptureError
from pcdata.files.opening import check_inside, read_text
from pcdata.geometry import rigid
from pcdata.io.calibration.pose_nodes import number
from pcdata.io.sources.hand_eye_names import POSE_LIST, ROBOT_CAL_TOOLS
from pcdata.structures import Camera
from pcdata.yaml_nodes import YamlDocument

_CAMERAS = ("camera_intr_calibrated.yaml", "camera_intr.yaml")  # the first that is there
_TARGET = "target.yaml"
_CHARUCO = "CharucoGridTargetFinderPlugin"
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_INTRINSICS = ("fx", "fy", "cx", "cy")
_UNIT_QUATERNION = 1e-3


def read_robot_cal_tools_set(folder: Path) -> HandEyeSet:
    """Read the list, its poses and what describes camera and target; the images need not be there.

    Raises:
        CaptureError: a file is missing that is named, or leads out of the folder.
        CalibrationError: every fault in a file, with its place.
    """
    file = folder / POSE_LIST
    document = YamlDocument(read_text("read_robot_poses", file), str(file), error=CalibrationError)
    robot, images = {}, {}
    for index, node in enumerate(document.sequence(document.root, POSE_LIST)):
        entry = document.mapping(node, f"entry {index}")
        said = {key: document.word(entry[key][1]) for key in ("pose", "image") if key in entry}
        pose, image = said.get("pose"), said.get("image")
        if pose is None or image is None:
            document.fault(node, f"entry {index}: needs the names of a 'pose' and an 'image'")
            continue
        name = Path(pose).stem
        if name in robot:
            document.fault(node, f"entry {index}: pose {name!r:.60} is listed twice")
            continue
        for part in (pose, image):
            check_inside("read_robot_poses", folder / part, [folder])
        robot[name] = _pose(folder / pose)
        images[name] = folder / image
    document.raise_faults()
    camera_for, camera_said = _camera(folder)
    board, board_said = _board(folder)
    return HandEyeSet(ROBOT_CAL_TOOLS, robot, {}, images, camera_for, camera_said, board, board_said)


def _named_numbers(file: Path, key: str | None, names: tuple[str, ...]) -> list[float]:
    document = YamlDocument(read_text("read_robot_poses", file), str(file), error=CalibrationError)
    top = document.mapping(document.root, file.name)
    if key is not None and key in top:
        top = document.mapping(top[key][1], key)
    for name in names:
        if name not in top:
            document.fault(document.root, f"{name!r} is missing; {', '.join(names)} are needed")
    values = [number(document, top[name][1], name) for name in names if name in top]
    document.raise_faults()
    return [value for value in values if value is not None]


def _pose(file: Path) -> Tensor:
    values = _named_numbers(file, None, _POSE)
    length = math.hypot(*values[3:])
    if abs(length - 1) > _UNIT_QUATERNION:
        raise CalibrationError(f"{file}: the quaternion qx qy qz qw must have length 1, has {length:.6g}")
    vector = torch.tensor(values, dtype=torch.float64, device="cpu")
    return rigid.from_rotation_translation(rigid.rotation_from_quaternion(vector[3:]), vector[:3])


def _camera(folder: Path) -> tuple[Callable[[Size], Camera] | None, str]:
    file = next((folder / name for name in _CAMERAS if (folder / name).is_file()), None)
    if file is None:
        return None, f"none of {', '.join(_CAMERAS)} is there"
    values = dict(zip(_INTRINSICS, _named_numbers(file, "intrinsics", _INTRINSICS)))
    said = " ".join(f"{name} {value:.2f}" for name, value in values.items())
    return partial(_camera_of_size, values), f"{file.name}: {said}, without distortion"


def _camera_of_size(values: dict[str, float], size: Size) -> Camera:
    return Camera.pinhole(fx=values["fx"], fy=values["fy"], cx=values["cx"], cy=values["cy"], size=size)


def _board(folder: Path) -> tuple[Board | None, str]:
    file = folder / _TARGET
    ask = "describe the target by --board"
    if not file.is_file():
        return None, f"{_TARGET} is not there; {ask}"
    document = YamlDocument(read_text("read_robot_poses", file), str(file), error=CalibrationError)
    top = document.mapping(document.root, _TARGET)
    target = document.mapping(top["target_finder"][1] if "target_finder" in top else document.root, "target_finder")
    kind = (document.word(target["type"][1]) if "type" in target else None) or "of no type"
    document.raise_faults()
    if kind.rpartition("::")[2] != _CHARUCO:
        return None, (
            f"its target ({kind[:80]}, {_TARGET}) is none that is located here; a ChArUco board, a chessboard and a "
            "tag are. Locate it in each image with the tool that it belongs to, and give the poses as "
            "camera_from_target in a file of poses (docs/calibration.md)"
        )
    cols, rows, square, marker, dictionary = _named_numbers(
        file, "target_finder", ("cols", "rows", "chessboard_dim", "aruco_marker_dim", "dictionary")
    )
    if any(value != int(value) for value in (cols, rows, dictionary)):
        raise CaptureError(f"{file}: cols, rows and dictionary must be whole numbers, got {cols}, {rows}, {dictionary}")
    return Charuco(int(cols), int(rows), square, marker, dictionary_of_number(int(dictionary))), _TARGET
