"""Intrinsics and poses as other programs write them beside their images: one row a kind of file.

Source: Berkeley AUTOLAB, perception (``.intr``) and autolab_core (``.tf``); librealsense, rs-enumerate-devices -c;
Open3D, PinholeCameraIntrinsic (the matrix column by column); M2T2, meta_data; ClearGrasp, camera_intrinsics.yaml.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pcdata.errors import CaptureError, ConfigError, IntrinsicsError, PcdataError
from pcdata.files.library_errors import told_by_library
from pcdata.files.number_words import numbers_of
from pcdata.files.opening import read_bytes, read_text
from pcdata.files.strict_json import json_object
from pcdata.functional.depth.unit_fit import DepthEncoding
from pcdata.geometry import rigid
from pcdata.io.arrays.plain_pickles import read_plain_pickle
from pcdata.io.calibration.capture_camera import capture_camera_of
from pcdata.io.calibration.stated_lens import lens_of
from pcdata.structures import Camera

Size = tuple[int, int]  # (height, width)
_MAX_PICKLE = 1 << 27
_YAML_LINE = re.compile(r"^(\w+):[ \t]*([^#\n]*?)[ \t]*(?:#[^\n]*)?$", re.MULTILINE)  # flat: one number a line
_REALSENSE = re.compile(
    r'Intrinsic of "Depth" /[^\n]*\n\s*Width:\s*(\d+)\s*\n\s*Height:\s*(\d+)\s*\n\s*PPX:\s*(\S+)\s*\n\s*PPY:\s*(\S+)'
    r"\s*\n\s*Fx:\s*(\S+)\s*\n\s*Fy:\s*(\S+)\s*\n\s*Distortion:\s*([^\n]*?)\s*\n\s*Coeffs:([^\n]*)"
)
_REALSENSE_PAIR = re.compile(
    r'Extrinsic from "Infrared 1"\s+To\s+"Infrared 2"\s*:[^\S\n]*\n\s*Rotation Matrix:(?:[^\n]*\n){1,5}?'
    r"\s*Translation Vector:\s*(\S+)\s+(\S+)\s+(\S+)"
)


class ForeignCamera(NamedTuple):
    """What a file says of the camera beside it."""

    camera: Callable[[Size], Camera] | None = None  # of an image of this size; can be pickled
    pose: Tensor | None = None  # (4, 4) float64, the frame from the camera
    frame: str | None = None  # that the pose leads to
    metres_per_unit: float | None = None  # as our own files say it
    depth_encoding: DepthEncoding | None = None
    invalid_values: tuple[int, ...] | None = None
    poses: Mapping[str, Tensor] | None = None  # signals: (4, 4) float64 of other things, in the same frame
    baseline: float | None = None  # metres, of the two cameras that a stereo camera is made of


def read_foreign_camera(
    path: Path,
    inside: Iterable[Path] | None = None,
) -> ForeignCamera | None:
    """Return what a file says, None where it is of no known kind.

    Raises:
        CaptureError: it is of a known kind by its name, but cannot be read.
        PoseError, IntrinsicsError: its numbers cannot be right.
    """
    for pattern, read in _ROWS.items():
        if fnmatchcase(path.name.lower(), pattern):
            where = f"read_foreign_camera: {path}"
            try:
                if path.suffix.lower() == ".pkl":
                    content = read_bytes(where, path, max_bytes=_MAX_PICKLE, inside=inside)
                    return _m2t2_said(where, read_plain_pickle(where, content))
                return read(where, read_text(where, path, inside=inside))
            except PcdataError:
                raise
            except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
                raise CaptureError(
                    f"{where}: is not as files of this name are: {told_by_library(error)}; is it another file, or "
                    "damaged?"
                ) from error
    return None


def pinhole(
    size: Size,
    numbers: tuple[float, float, float, float],  # fx, fy, cx, cy
    distortion: Sequence[float] | None = None,
    of_size: Size | None = None,
) -> Camera:
    """Return the camera of an image of this size, which must be the one that its numbers belong to, where known."""
    if of_size is not None and of_size != size:
        raise IntrinsicsError(
            f"the intrinsics are of {of_size[1]}x{of_size[0]} pixels, the image has {size[1]}x{size[0]}; give those of "
            "this size"
        )
    lens = None if distortion is None or not any(distortion) else distortion
    fx, fy, cx, cy = numbers
    return Camera.pinhole(fx=fx, fy=fy, cx=cx, cy=cy, size=size, distortion=lens)


def _same_size(camera: Camera, size: Size) -> Camera:
    return camera  # what joins it with an image requires the size


def pinhole_of_matrix(where: str, matrix: Any, of_size: Size | None = None) -> Callable[[Size], Camera]:
    """Return what makes cameras of a 3x3 (or the corner of a 4x4) intrinsics matrix, given row by row.

    Raises:
        IntrinsicsError: it is no such matrix.
    """
    try:
        rows = [[float(value) for value in row] for row in matrix]
        (fx, skew, cx), (zero, fy, cy), last = (row[:3] for row in rows[:3])
    except (TypeError, ValueError, OverflowError) as error:
        raise IntrinsicsError(f"{where}: the intrinsics must be a 3x3 matrix, got {str(matrix)[:200]}") from error
    if skew or zero or last != [0.0, 0.0, 1.0]:
        raise IntrinsicsError(
            f"{where}: must be fx 0 cx / 0 fy cy / 0 0 1, got {rows}; is it transposed, or a projection matrix?"
        )
    return partial(_pinhole_at, where=where, numbers=(fx, fy, cx, cy), of_size=of_size)


def _pinhole_at(size: Size, where: str, numbers: tuple[float, float, float, float], of_size: Size | None) -> Camera:
    try:
        return pinhole(size, numbers, of_size=of_size)
    except PcdataError as error:
        raise IntrinsicsError(f"{where}: {error}") from error


def matrix_of(where: str, values: Sequence[Any], *, scale: float = 1.0) -> Tensor:  # (4, 4) float64, rigid
    """Return a rigid matrix of 12 or 16 numbers, row by row, its translation times ``scale``.

    Raises:
        PoseError: it is not rigid, or not finite (tracking lost).
        CaptureError: it has other numbers.
    """
    try:
        numbers = torch.tensor([float(value) for value in values], dtype=torch.float64, device="cpu")
    except (TypeError, ValueError, OverflowError) as error:
        raise CaptureError(f"{where}: a pose must be numbers, got {values!r:.100}") from error
    if len(numbers) not in (12, 16):
        raise CaptureError(f"{where}: a pose must be 12 or 16 numbers, row by row, got {len(numbers)}")
    matrix = torch.eye(4, dtype=torch.float64, device="cpu")
    matrix[: len(numbers) // 4] = numbers.reshape(-1, 4)
    matrix[:3, 3] *= scale
    rigid.check_rigid(where, matrix)
    return matrix


def check_motion(where: str, option: str, numbers: Any) -> Tensor:  # (4, 4) float64
    """Return a rigid motion from its 16 numbers, row by row.

    Raises:
        ConfigError: they are no list.
        PoseError: they are not 16, or not rigid.
    """
    if not isinstance(numbers, (list, tuple)):
        raise ConfigError(f"{where}: {option} must be 16 numbers, row by row, got {numbers!r:.100}")
    return matrix_of(f"{where}: {option}", numbers)


def _autolab_intrinsics(where: str, text: str) -> ForeignCamera:
    said = json_object(where, text, error=CaptureError)
    if said.get("_skew"):
        raise IntrinsicsError(f"{where}: has the skew {said['_skew']!r}, which no camera here can have")
    numbers = (float(said["_fx"]), float(said["_fy"]), float(said["_cx"]), float(said["_cy"]))
    return ForeignCamera(partial(pinhole, numbers=numbers, of_size=(int(said["_height"]), int(said["_width"]))))


def _autolab_transform(where: str, text: str) -> ForeignCamera:
    _, target, *rows = text.strip().splitlines()
    shift, *turn = (numbers_of(row) for row in rows)
    pose = matrix_of(where, [number for row, moved in zip(turn, shift, strict=True) for number in (*row, moved)])
    return ForeignCamera(pose=pose, frame=target.strip())


def _yaml_intrinsics(where: str, text: str) -> ForeignCamera:
    said = dict(_YAML_LINE.findall(text))
    size = (int(said["yres"]), int(said["xres"])) if "xres" in said else None
    numbers = (float(said["fx"]), float(said["fy"]), float(said["cx"]), float(said["cy"]))
    return ForeignCamera(partial(pinhole, numbers=numbers, of_size=size))


def _text_intrinsics(where: str, text: str) -> ForeignCamera:
    if "Intrinsic of" not in text:
        numbers = numbers_of(text)
        if len(numbers) not in (9, 16):
            raise CaptureError(f"{where}: must hold a 3x3 matrix, nine numbers, got {len(numbers)}")
        side = 3 if len(numbers) == 9 else 4
        rows = [numbers[start : start + side] for start in range(0, len(numbers), side)]
        return ForeignCamera(pinhole_of_matrix(where, rows))
    streams: dict[Size, tuple[float, ...]] = {}
    for width, height, cx, cy, fx, fy, lens, coefficients in _REALSENSE.findall(text):
        bent = lens_of(f"{where}: the depth stream", lens, numbers_of(coefficients)) or ()
        streams[int(height), int(width)] = (*map(float, (fx, fy, cx, cy)), *bent)
    if not streams:
        raise CaptureError(f'{where}: names no intrinsics of the stream "Depth"')
    pair = _REALSENSE_PAIR.search(text)
    apart = None if pair is None else math.dist([0.0] * 3, [float(shift) for shift in pair.groups()])
    return ForeignCamera(partial(_realsense, streams=streams), baseline=apart)


def _realsense(size: Size, *, streams: Mapping[Size, tuple[float, ...]]) -> Camera:
    if size not in streams:
        known = ", ".join(f"{width}x{height}" for height, width in streams)
        raise IntrinsicsError(f"the depth stream has intrinsics of {known}, the image has {size[1]}x{size[0]} pixels")
    fx, fy, cx, cy, *lens = streams[size]
    return pinhole(size, (fx, fy, cx, cy), tuple(lens))


def _m2t2(where: str, text: str) -> ForeignCamera:
    return _m2t2_said(where, json_object(where, text, error=CaptureError))


def _m2t2_said(where: str, said: Any) -> ForeignCamera:
    pose = matrix_of(f"{where}: camera_pose", [value for row in said["camera_pose"] for value in row])
    hand = {
        name: matrix_of(f"{where}: {name}", [value for row in said[name] for value in row])
        for name in ("ee_pose",)
        if said.get(name) is not None
    }
    return ForeignCamera(pinhole_of_matrix(where, said["intrinsics"]), pose, "base", poses=hand or None)


def _open3d(where: str, text: str) -> ForeignCamera:
    said = json_object(where, text, error=CaptureError)
    if "intrinsic_matrix" not in said:
        stated = capture_camera_of(where, said)
        if stated.calibration is not None or stated.folders is not None:
            raise CaptureError(f"{where}: 'calibration' and 'folders' are for captures of the layout 'folder'")
        return ForeignCamera(
            partial(_same_size, stated.camera),
            frame=stated.frame_id,
            metres_per_unit=stated.metres_per_unit,
            depth_encoding=stated.depth_encoding,
            invalid_values=stated.invalid_values,
        )
    columns = [float(value) for value in said["intrinsic_matrix"]]
    rows = [columns[start::3] for start in range(3)]
    return ForeignCamera(pinhole_of_matrix(where, rows, (int(said["height"]), int(said["width"]))))


_ROWS: dict[str, Callable[[str, str], ForeignCamera]] = {  # by the name of the file, in lower case
    "*.intr": _autolab_intrinsics,
    "*_to_*.tf": _autolab_transform,
    "*intrinsic*.yaml": _yaml_intrinsics,
    "*intrinsic*.txt": _text_intrinsics,
    "meta_data.json": _m2t2,
    "meta_data.pkl": _m2t2,
    "camera*.json": _open3d,
    "intrinsic*.json": _open3d,
}
