"""Robot and target poses of a hand-eye calibration, and the files that hold them."""

from __future__ import annotations

import csv
import io
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import cast

import torch
import yaml
from torch import Tensor

from pcdata.calibration.boards import Board
from pcdata.calibration.hand_eye_set import HandEyeSet
from pcdata.calibration.robot_cal_tools_set import read_robot_cal_tools_set
from pcdata.calibration.visp_set import read_visp_set
from pcdata.errors import CalibrationError, CaptureError, ShapeError, first_lines, locates_path, near_matches
from pcdata.files.opening import read_text
from pcdata.files.sample_names import name_some
from pcdata.geometry import rigid
from pcdata.io.calibration.pose_nodes import POSE_KEYS, known_entries, matrix_from_node, pose_from_entries
from pcdata.io.sources.hand_eye_names import (
    MOVEIT,
    MOVEIT_FILE,
    ROBOT_CAL_TOOLS,
    VISP,
    hand_eye_folders,
    hand_eye_tool,
)
from pcdata.io.sources.listing import absolute, is_folder
from pcdata.structures import Camera
from pcdata.structures.calibration import LARGEST_TRANSLATION, RIGID_TOLERANCE
from pcdata.yaml_nodes import YamlDocument

ROBOT, TARGET, IMAGE = "base_from_gripper", "camera_from_target", "image"
_PARTS = ("x", "y", "z", "qx", "qy", "qz", "qw")
_UNIT_QUATERNION = 1e-3
_MAX_COLUMNS = 100  # of a table; 15 are known
_MAX_LINES = 5000  # of a table; some 20 poses calibrate a camera


@dataclass(frozen=True, eq=False, kw_only=True)
class RobotPoses:
    """N moments in which the robot stood still and the camera saw the target; metres."""

    names: tuple[str, ...]
    base_from_gripper: Tensor  # (N, 4, 4) float64
    camera_from_target: Tensor  # (N, 4, 4) float64
    reprojection_rms: tuple[float | None, ...] = ()  # pixels, per pose; empty or None where no image was looked at
    read_from: tuple[str, ...] = ()  # what a folder's files said besides the poses, in words

    def __post_init__(self) -> None:
        for name in (ROBOT, TARGET):
            poses = getattr(self, name)
            if poses.shape != (len(self.names), 4, 4) or poses.dtype != torch.float64:
                raise ShapeError(
                    f"RobotPoses: {name} must be ({len(self.names)}, 4, 4) float64, one per name, got {poses.dtype} "
                    f"{tuple(poses.shape)}"
                )
            _check_pose(f"RobotPoses: {name}", poses)
        if len(set(self.names)) != len(self.names):
            raise CalibrationError(f"RobotPoses: names must be unique, got {', '.join(self.names)}")


@locates_path
def read_robot_poses(
    path: str | os.PathLike[str],
    *,
    locate: Callable[[Path], Tensor] | None = None,
    board: Board | None = None,
    camera: Camera | None = None,
) -> RobotPoses:
    """Read a YAML, JSON or CSV file of poses, or a folder that a tool saved; ``docs/calibration.md`` describes them.

    Args:
        path: the file; its suffix says which kind it is.
        locate: returns ``camera_from_target`` of an image, for entries that name an ``image`` in its place.
        board: the target in a folder's images, in place of the one that its files describe.
        camera: the camera of a folder's images, in place of the one that its files describe.

    Raises:
        CaptureError: the file is missing or not text; a folder holds no poses, or lacks images, which are named.
        CalibrationError: every fault in it, with its place.
        ConfigError: a folder's files describe no board, or no camera, and none is given.
    """
    file = Path(path)
    if is_folder(absolute(path)):
        if hand_eye_tool(absolute(path)) == MOVEIT:
            return read_robot_poses(file / MOVEIT_FILE)
        return _from_set(read_hand_eye_set(absolute(path)), str(path), board, camera)
    text = read_text("read_robot_poses", file)
    if file.suffix.lower() == ".csv":
        return _from_csv(text, str(path))
    if file.suffix.lower() == ".json":
        text = text.replace("\t", " ")  # JSON is YAML but for tabs, which it has between values only
    elif file.suffix.lower() not in (".yaml", ".yml"):
        raise CalibrationError(f"{path}: poses are read from .yaml, .json and .csv, not {file.suffix or 'such a file'}")
    return _from_yaml(text, str(path), file.parent, locate)


def read_hand_eye_set(folder: Path) -> HandEyeSet:
    """Read what a tool for hand-eye calibration saved in a folder; its images are not looked at.

    Raises:
        CaptureError: no such tool saved it.
        CalibrationError: every fault in its files, with its place.
    """
    reader = {VISP: read_visp_set, ROBOT_CAL_TOOLS: read_robot_cal_tools_set}.get(hand_eye_tool(folder))
    if reader is not None:
        return reader(folder)
    inside = [f"{folder.name}/{one.name}" for one in hand_eye_folders(folder)]
    advice = (
        f"give one of the folders in it: {name_some(inside)}" if inside else "docs/calibration.md lists what is read"
    )
    raise CaptureError(f"{folder}: is a folder without poses of a robot; {advice}")


def _from_set(found: HandEyeSet, name: str, board: Board | None, camera: Camera | None) -> RobotPoses:
    targets = found.targets(name, board, camera)
    names = [one for one in found.base_from_gripper if one in targets]
    said = [f"saved by {found.tool}"]
    if any(rms is not None for _, rms in targets.values()):
        said.append(f"camera: {found.camera_said}" if camera is None else "camera: as given")
        said.append(f"board: {found.board} ({found.board_said})" if board is None else f"board: {board}, as given")
    if unseen := [found.images[one].name for one in found.base_from_gripper if one not in targets]:
        said.append(f"no board in {name_some(unseen)}")
    for one in names:
        _check_pose(f"{name}: {one}: {ROBOT}", found.base_from_gripper[one])
    joined = _joined(name, names, [found.base_from_gripper[one] for one in names], [targets[one][0] for one in names])
    return replace(joined, reprojection_rms=tuple(targets[one][1] for one in names), read_from=tuple(said))


def _from_yaml(text: str, name: str, folder: Path, locate: Callable[[Path], Tensor] | None) -> RobotPoses:
    document = YamlDocument(text, name, error=CalibrationError)
    if isinstance(document.root, yaml.SequenceNode) and name.lower().endswith(".json"):
        return _from_moveit(document, document.root, name)
    _check_no_joints(document)
    top = known_entries(document, document.root, "a file of poses", required=("unit", "poses"))
    if "unit" in top and (unit := document.plain(top["unit"][1])) != "metre":
        document.fault(top["unit"][1], f"unit must be 'metre', got {unit!r}; convert every translation to metres")
    names, robot, target = [], [], []
    for index, node in enumerate(document.sequence(top["poses"][1], "poses") if "poses" in top else []):
        entries = known_entries(document, node, f"pose {index}", required=(ROBOT,), optional=("name", TARGET, IMAGE))
        names.append(str(document.plain(entries["name"][1])) if "name" in entries else str(index))
        if ROBOT in entries:
            robot.append(_read_pose(document, entries[ROBOT][1], f"pose {index}: {ROBOT}"))
        if (TARGET in entries) == (IMAGE in entries):
            document.fault(node, f"pose {index}: give either {TARGET} or {IMAGE}")
        elif TARGET in entries:
            target.append(_read_pose(document, entries[TARGET][1], f"pose {index}: {TARGET}"))
        elif locate is None:
            document.fault(entries[IMAGE][0], f"pose {index}: an {IMAGE} needs a board and a calibrated camera with it")
        else:
            target.append(locate(folder / str(document.plain(entries[IMAGE][1]))))
    document.raise_faults()
    return _joined(name, names, cast("list[Tensor]", robot), cast("list[Tensor]", target))


def _check_no_joints(document: YamlDocument) -> None:
    """Name measurements of joints for what they are: each entry would else be an unknown key."""
    root = document.root
    entries = [value for _, value in root.value] if isinstance(root, yaml.MappingNode) else []
    for entry in entries[:1]:
        keys = {str(key.value) for key, _ in entry.value} if isinstance(entry, yaml.MappingNode) else set()
        if any(key.endswith("joints") for key in keys):
            raise CalibrationError(
                f"{document.name}: its {len(entries)} entries have angles of joints ({', '.join(sorted(keys))[:80]}), "
                "and no file here tells the kinematics; write what the robot's model makes of them as base_from_gripper"
            )


def _from_moveit(document: YamlDocument, root: yaml.SequenceNode, name: str) -> RobotPoses:
    """Read what MoveIt Calibration saves: pairs of 4x4 matrices, metres as all of ROS.

    Source: moveit_calibration, ``HandEyeSolverBase``: the effector in the robot's base, the object in the camera.
    """
    robot, target = [], []
    for index, node in enumerate(root.value):
        pair = document.sequence(node, f"sample {index}")
        if len(pair) != 2:
            document.fault(node, f"sample {index}: must be a pair, the effector's pose and the object's, 4x4 each")
            continue
        robot.append(_read_pose(document, pair[0], f"sample {index}: {ROBOT}"))
        target.append(_read_pose(document, pair[1], f"sample {index}: {TARGET}"))
    document.raise_faults()
    return _joined(name, [*map(str, range(len(robot)))], cast("list[Tensor]", robot), cast("list[Tensor]", target))


def _read_pose(document: YamlDocument, node: yaml.Node, what: str) -> Tensor | None:
    """Read four rows of four numbers, or a mapping as in a calibration file."""
    if not isinstance(node, yaml.SequenceNode):
        entries = known_entries(document, node, what, optional=POSE_KEYS)
        return pose_from_entries(document, node, entries, what, partial(_check_pose, what))
    pose = matrix_from_node(document, node, what)
    if pose is not None:
        try:
            _check_pose(what, pose)
        except ValueError as error:
            document.fault(node, str(error))
    return pose


def _check_pose(what: str, pose: Tensor) -> None:
    rigid.check_rigid(what, pose, tolerance=RIGID_TOLERANCE)
    length = max(pose[..., :3, 3].norm(dim=-1).flatten().tolist(), default=0.0)
    if length > LARGEST_TRANSLATION:
        raise CalibrationError(f"{what}: the translation is {length:g} m long; is it in millimetres? Write metres")


def _from_csv(text: str, name: str) -> RobotPoses:
    """Read a header and one line per pose: positions in metres and quaternions in x y z w order."""
    try:
        lines = list(csv.reader(io.StringIO(text), strict=True))
    except csv.Error as error:
        raise CalibrationError(f"{name}: not a table of comma-separated values: {error}") from error
    header = [column.strip() for column in lines[0]] if lines else []
    if len(header) > _MAX_COLUMNS or len(lines) > _MAX_LINES:
        raise CalibrationError(
            f"{name}: a table of {len(lines)} lines, {len(header)} columns in the first, is none of poses; at most "
            f"{_MAX_LINES} lines of {_MAX_COLUMNS} columns are read"
        )
    wanted = [f"{pose}.{part}" for pose in (ROBOT, TARGET) for part in _PARTS]
    faults = [f"{name}:1: column {column!r} is missing" for column in wanted if column not in header]
    known = ["name", *wanted]
    faults += [f"{name}:1: no such column {c!r}{near_matches(c, known)}" for c in header if c not in known]
    faults += [f"{name}:1: column {c!r} is given twice" for c in sorted(set(header)) if header.count(c) > 1]
    if faults:
        raise CalibrationError(first_lines(faults))
    names: list[str] = []
    robot: list[Tensor] = []
    target: list[Tensor] = []
    for number, line in enumerate(lines[1:], start=2):
        if not any(cell.strip() for cell in line):
            continue
        if len(line) != len(header):
            faults.append(f"{name}:{number}: {len(line)} values for {len(header)} columns")
            continue
        row = dict(zip(header, (cell.strip() for cell in line)))
        names.append(row.get("name") or str(len(names)))
        for poses, pose in ((robot, ROBOT), (target, TARGET)):
            try:
                poses.append(_pose_of_row(f"{name}:{number}: {pose}", [row[f"{pose}.{part}"] for part in _PARTS]))
            except ValueError as error:
                faults.append(str(error))
    if faults:
        raise CalibrationError(first_lines(faults))
    return _joined(name, names, robot, target)


def _pose_of_row(what: str, cells: Sequence[str]) -> Tensor:
    try:
        values = torch.tensor([float(cell) for cell in cells], dtype=torch.float64, device="cpu")
    except ValueError as error:
        raise CalibrationError(f"{what}: must be seven numbers: {error}") from error
    length = float(values[3:].norm())
    if not abs(length - 1) <= _UNIT_QUATERNION:
        raise CalibrationError(f"{what}: the quaternion must have length 1, has {length:.6g}")
    pose = rigid.from_rotation_translation(rigid.rotation_from_quaternion(values[3:]), values[:3])
    _check_pose(what, pose)
    return pose


def _joined(name: str, names: list[str], robot: list[Tensor], target: list[Tensor]) -> RobotPoses:
    if not names:
        raise CalibrationError(f"{name}: holds no pose")
    if len(set(names)) != len(names):
        twice = {one for one, count in Counter(names).items() if count > 1}
        raise CalibrationError(f"{name}: every pose needs a name of its own; {name_some(twice)} comes more than once")
    return RobotPoses(names=tuple(names), base_from_gripper=torch.stack(robot), camera_from_target=torch.stack(target))
