"""What ViSP's tools for hand-eye calibration save: poses by number, the image of each, the camera in XML.

Source: ViSP, vpXmlParserCamera (projection models), vpPoseVector (translation, then axis times angle in radians),
tutorials "Camera eye-in-hand / eye-to-hand extrinsic calibration" (file names; rPe, fPe: end effector in the robot's
reference frame; cPo: object in the camera).
"""

from __future__ import annotations

import math
import re
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pcdata.calibration.board_images import IMAGE_SUFFIXES
from pcdata.calibration.boards import Board, Chessboard, Tag
from pcdata.calibration.hand_eye_set import HandEyeSet, Size
from pcdata.errors import CalibrationError, CaptureError, ConfigError
from pcdata.files.opening import read_text
from pcdata.files.sample_names import name_some
from pcdata.files.xml import xml_root
from pcdata.geometry import rigid
from pcdata.io.calibration.pose_nodes import matrix_from_node, numbers, rotation_from_vector
from pcdata.io.sources.hand_eye_names import VISP, VISP_POSE
from pcdata.io.sources.listing import visible_files
from pcdata.structures import Camera
from pcdata.yaml_nodes import YamlDocument

_WITHOUT, _WITH = "perspectiveProjWithoutDistortion", "perspectiveProjWithDistortion"
_TAG_FAMILIES = r"16h5|25h9|36h10|36h11"
_LONGEST_NOTE = 2000  # characters
_ASK = (
    "describe the target: --board chessboard:COLSxROWS:SQUARE (inner corners), charuco:COLSxROWS:SQUARE:MARKER:DICT "
    "or tag:APRILTAG_36h11:SIDE, metres"
)


def read_visp_set(folder: Path) -> HandEyeSet:
    """Read the poses and what is beside them.

    Raises:
        CaptureError: a file is none of its kind.
        CalibrationError: every fault in the poses, with its place.
    """
    files = visible_files(folder)
    matches = [(match, file) for file in files if (match := VISP_POSE.fullmatch(file.name))]
    robot: dict[str, Tensor] = {}
    target: dict[str, Tensor] = {}
    images: dict[str, Path] = {}
    for match, file in sorted(matches, key=lambda one: int(one[0]["number"])):
        number = str(int(match["number"]))
        if number in robot:
            raise CalibrationError(f"{folder}: there are two poses of number {number}; remove one")
        robot[number] = _pose(file)
        saved = [file.with_name(f"{match['start']}pose_cPo_{match['number']}{end}") for end in (".yaml", ".yml")]
        for file_of_target in filter(Path.is_file, saved):
            target[number] = _pose(file_of_target)
        images[number] = _image(folder, files, match["start"], match["number"])
    camera_for, camera_said = _camera([file for file in files if file.suffix.lower() == ".xml"])
    board, board_said = _board([file for file in files if file.suffix.lower() == ".txt"])
    return HandEyeSet(VISP, robot, target, images, camera_for, camera_said, board, board_said)


def _image(folder: Path, files: list[Path], start: str, number: str) -> Path:
    """Return the image of a number, or where it belongs."""
    likely = [
        file
        for file in files
        if file.suffix.lower() in IMAGE_SUFFIXES and re.fullmatch(rf".*?(?<!\d)0*{int(number)}", file.stem)
    ]
    if len(likely) > 1:
        raise CaptureError(f"{folder}: which image belongs to pose {number}: {name_some(f.name for f in likely)}?")
    return likely[0] if likely else folder / f"{start}image-{number}.png"


def _pose(file: Path) -> Tensor:
    document = YamlDocument(read_text("read_robot_poses", file), str(file), error=CalibrationError)
    top = document.mapping(document.root, "a pose of ViSP")
    pose = None
    if "data" not in top:
        document.fault(document.root, "a pose of ViSP has rows, cols and data; 'data' is missing")
    else:
        rows = document.sequence(top["data"][1], "data")
        if len(rows) == 4:
            pose = matrix_from_node(document, top["data"][1], "data")
        elif len(rows) == 6:
            values = [numbers(document, row, "data", (1,)) for row in rows]
            flat = [value[0] for value in values if value is not None]
            if len(flat) == 6 and math.hypot(*flat[3:]) > 2 * math.pi:
                document.fault(
                    top["data"][1], "the last three numbers are axis times angle in radians; are these degrees?"
                )
            elif len(flat) == 6:
                vector = torch.tensor(flat, dtype=torch.float64, device="cpu")
                pose = rigid.from_rotation_translation(rotation_from_vector(vector[3:]), vector[:3])
        else:
            document.fault(top["data"][1], f"a pose has 6 rows (tx ty tz and axis times angle) or 4, got {len(rows)}")
    document.raise_faults()
    assert pose is not None  # or a fault was noted
    return pose


class _Model(NamedTuple):
    size: Size
    distorted: bool
    values: tuple[float, float, float, float, float]  # fx fy cx cy, k1


def _camera(files: list[Path]) -> tuple[Any, str]:
    described = {file: _models(file) for file in files}
    files = [file for file, models in described.items() if models]
    if len(files) != 1:
        found = f"there are {len(files)}: {name_some(file.name for file in files)}" if files else "there is none"
        return None, f"the camera is read from one ViSP .xml file with <camera>; {found}"
    models = described[files[0]]
    fx, fy, cx, cy, k1 = models[-1].values
    height, width = models[-1].size
    said = f"{files[0].name}: {width}x{height}, fx {fx:.2f} fy {fy:.2f} cx {cx:.2f} cy {cy:.2f}, k1 {k1 + 0.0:g}"
    return partial(_camera_of_size, str(files[0]), models), said


def _camera_of_size(where: str, models: list[_Model], size: Size) -> Camera:
    """Return the camera of that image size; the model with distortion where both are saved."""
    fitting = sorted((model for model in models if model.size == size), key=lambda model: model.distorted)
    if not fitting:
        sizes = ", ".join(sorted({f"{model.size[1]}x{model.size[0]}" for model in models}))
        raise CaptureError(f"{where}: describes cameras of {sizes}, the images are {size[1]}x{size[0]}")
    if len({model.values for model in fitting if model.distorted == fitting[-1].distorted}) > 1:
        raise CaptureError(
            f"{where}: describes several cameras of {size[1]}x{size[0]}; leave the one that took the images"
        )
    fx, fy, cx, cy, k1 = fitting[-1].values
    distortion = [k1, 0.0, 0.0, 0.0] if k1 else None
    return Camera.pinhole(fx=fx, fy=fy, cx=cx, cy=cy, size=size, distortion=distortion)


def _models(file: Path) -> list[_Model]:
    root = xml_root(f"read_robot_poses: {file}", read_text("read_robot_poses", file))
    found = []
    for camera in root.iter("camera"):
        size = (round(_number(file, camera, "image_height")), round(_number(file, camera, "image_width")))
        for model in camera.iter("model"):
            kind = (model.findtext("type") or "").strip()
            if kind not in (_WITH, _WITHOUT):
                raise CaptureError(
                    f"{file}: the projection model {kind[:60]!r} is not read, {_WITH} and {_WITHOUT} are; save the "
                    "camera with one of them, or give --calibration FILE"
                )
            fx, fy, cx, cy = (_number(file, model, name) for name in ("px", "py", "u0", "v0"))
            # "Undistorted to distorted": u = u0 + px x (1 + kud r^2), which is OpenCV's k1; kdu is its inverse.
            k1 = _number(file, model, "kud") if kind == _WITH else 0.0
            found.append(_Model(size, kind == _WITH, (fx, fy, cx, cy, k1)))
    return found


def _number(file: Path, element: Any, name: str) -> float:
    text = (element.findtext(name) or "").strip()
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise CaptureError(f"{file}: <{name}> must be a number, got {text[:60]!r}")
    return value


def _board(files: list[Path]) -> tuple[Board | None, str]:
    """Read the target from a note beside the images, where one is plain: kind, counts and size with its unit."""
    found = {}
    for file in files:
        try:
            board = _board_of_note(read_text("read_robot_poses", file)[:_LONGEST_NOTE])
        except (ConfigError, CaptureError):
            continue
        if board is not None:
            found[file.name] = board
    if len(found) == 1:
        name, board = next(iter(found.items()))
        return board, name
    return None, _ASK


def _board_of_note(text: str) -> Board | None:
    sizes = re.findall(r"size\s*[:=]?\s*(\d*\.?\d+)\s*(mm|cm|m)\b", text, re.IGNORECASE)
    counts = re.findall(r"(?<![\d.])(\d{1,3})\s*x\s*(\d{1,3})(?![\d.])", text, re.IGNORECASE)
    families = {family.lower() for family in re.findall(_TAG_FAMILIES, text, re.IGNORECASE)}
    is_chessboard = re.search(r"chess|checker", text, re.IGNORECASE) is not None
    if len(sizes) != 1 or is_chessboard == bool(families) or len(families) > 1:
        return None
    side = float(sizes[0][0]) * {"m": 1.0, "cm": 0.01, "mm": 0.001}[sizes[0][1].lower()]
    if families:
        return Tag(f"APRILTAG_{families.pop()}", side)
    return Chessboard(int(counts[0][0]), int(counts[0][1]), side) if len(counts) == 1 else None
