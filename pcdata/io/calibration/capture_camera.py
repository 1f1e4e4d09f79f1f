"""Intrinsics and poses from the small text files that travel with a capture."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError, ConfigError, IntrinsicsError, PcdataError, PoseError, locates_path, near_matches
from pcdata.files.number_words import number_of
from pcdata.files.opening import map_npy, read_text, replacing
from pcdata.files.strict_json import json_object
from pcdata.functional.depth.unit_fit import DepthEncoding, check_depth_encoding
from pcdata.geometry import rigid
from pcdata.geometry.lens_models import LENS_MODELS, lens_row, model_named
from pcdata.io.sources.folder_roles import check_folders, is_within
from pcdata.io.sources.option_checks import check_invalid_values
from pcdata.structures import Camera

_SHOWN = 8  # faults of a file in one message
_REQUIRED = ("width", "height", "fx", "fy", "cx", "cy")
_STATED = {  # key: attribute of CaptureCamera; what a capture may say of itself
    "metres_per_unit": "metres_per_unit",
    "depth_encoding": "depth_encoding",
    "frame_id": "frame_id",
    "background_label": "background_label",
    "invalid_values": "invalid_values",
    "calibration": "calibration",
    "camera": "camera_name",
    "folders": "folders",
}
_REMARKS = ("notes", "sensor", "serial", "registered_to", "date")  # free text, not interpreted
REMARKS_OF = {"sensor_name": "sensor", "serial": "serial", "registered_to": "registered_to"}  # by key of provenance
_HINTS = {
    "depth_scale": "depth_scale has three incompatible meanings; write metres_per_unit (0.001 for millimetres)",
    "factor_depth": "write metres_per_unit = 1 / factor_depth",
    "intrinsic_matrix": "write fx, fy, cx, cy as four numbers (Open3D stores the matrix column by column)",
    "k": "write fx, fy, cx, cy as four numbers",
    "ppx": "write ppx, ppy as cx, cy",
    "ppy": "write ppx, ppy as cx, cy",
    "camera_matrix": "write fx, fy, cx, cy as four numbers",
    "coeffs": "write the lens coefficients as distortion",
    "dist_coeffs": "write the lens coefficients as distortion",
}
_SHORT_POSES = {  # by how many numbers a text has instead of sixteen
    12: "; the last row 0 0 0 1 is missing",
    7: "; a place and a quaternion are seven: write the matrix, "
    "[R, t] of scipy.spatial.transform.Rotation.from_quat(q) (x y z w) over 0 0 0 1",
}


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureCamera:
    """What a calibration file states of one camera."""

    camera: Camera
    metres_per_unit: float | None = None  # length of one stored depth unit; None = the file does not say
    depth_encoding: DepthEncoding | None = None  # order of the stored bits; None = the file does not say
    frame_id: str | None = None  # the frame that the poses beside it lead to; None = the file does not say
    background_label: int | None = None  # what means "no object" in the label images; None = the file does not say
    invalid_values: tuple[int, ...] | None = None  # stored depth besides 0 that is no reading; None = not said
    calibration: str | None = None  # a calibration file beside it, whose camera counts instead; None = not said
    camera_name: str | None = None  # which camera of that calibration; None = the only one
    folders: Mapping[str, str | None] | None = None  # names of the folders by role, where they are not the usual ones
    remarks: Mapping[str, str] = field(default_factory=dict)  # free text: sensor, serial, registered_to, notes, date


@locates_path
def read_capture_camera(path: str | os.PathLike[str]) -> CaptureCamera:
    """Read the intrinsics of one camera from a JSON file.

    Such as::

        {"width": 640, "height": 480, "fx": 585.0, "fy": 585.0, "cx": 320.0, "cy": 240.0,
         "distortion": [0.1, -0.2, 0.0, 0.0, 0.0], "metres_per_unit": 0.001, "frame_id": "base"}

    The last three are optional, as are ``lens``, the model of a lens that is not OpenCV's polynomial (see
    :meth:`~pcdata.Camera.pinhole`), ``skew`` in pixels, ``is_window`` of an image that was cut from a larger one,
    ``depth_encoding``, the order of the stored bits ("plain", "rotated" or
    "swapped"), ``background_label``, the id that means "no object", and ``invalid_values``, a list of stored depths
    besides 0 that mean "no reading"; ``calibration``, a calibration file beside this one whose camera counts instead,
    ``camera``, its name there, and ``folders``, names of folders by role; ``notes``, ``sensor``, ``serial``,
    ``registered_to`` and ``date`` are free remarks.

    Any other key is an error, because a misspelled ``distortion`` that is ignored bends every cloud.

    Raises:
        CaptureError: the file is missing, no JSON object, lacks or repeats a key, or a value is impossible.
        UnitError: ``metres_per_unit`` is not a number above 0 and at most 1, or ``depth_encoding`` is not known.
    """
    where = f"read_capture_camera: {path}"
    return capture_camera_of(where, json_object(where, read_text(where, path), error=CaptureError))


def read_camera(path: str | os.PathLike[str]) -> Camera:
    """Read a file that states the intrinsics of one image and nothing else, see :func:`read_capture_camera`.

    Raises:
        CaptureError: the file is missing or wrong, or states what is of all images, such as the unit.
    """
    stated = read_capture_camera(path)
    if others := [key for key, name in _STATED.items() if getattr(stated, name) is not None]:
        raise CaptureError(f"read_camera: {path}: {others[0]} is of all images; say it in intrinsics.json")
    return stated.camera


def capture_camera_of(where: str, data: dict[str, Any]) -> CaptureCamera:
    """Return what the JSON object of such a file states, see :func:`read_capture_camera`."""
    _check_keys(where, data)
    width, height = (_whole(where, data, key) for key in ("width", "height"))
    fx, fy, cx, cy = (_number(where, key, data[key]) for key in ("fx", "fy", "cx", "cy"))
    unit = data.get("metres_per_unit")
    encoding = data.get("depth_encoding")
    background = data.get("background_label")
    if background is not None and not (type(background) is int and 0 <= background <= 65535):
        raise CaptureError(f"{where}: 'background_label' must be an id in 0 .. 65535, got {background!r:.80}")
    frame_id, camera_name = (_name(where, data, key) for key in ("frame_id", "camera"))
    calibration = data.get("calibration")
    if calibration is not None and not is_within(calibration):
        raise CaptureError(f"{where}: 'calibration' must be the name of a file in this folder, got {calibration!r:.80}")
    invalid, folders = data.get("invalid_values"), data.get("folders")
    try:
        invalid = None if invalid is None else check_invalid_values(where, invalid)
        folders = None if folders is None else check_folders(where, folders)
    except ConfigError as error:  # what would be wrong of an argument is wrong in the file
        raise CaptureError(str(error)) from error
    is_window = data.get("is_window", False)
    if not isinstance(is_window, bool):
        raise CaptureError(f"{where}: 'is_window' must be true or false, got {is_window!r:.80}")
    camera = _camera(
        where,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        skew=_number(where, "skew", data.get("skew", 0.0)),
        size=(height, width),
        distortion=_distortion(where, data.get("distortion"), data.get("lens")),
        is_window=is_window,
    )
    return CaptureCamera(
        camera=camera,
        metres_per_unit=None if unit is None else check_metres_per_unit(where, unit),
        depth_encoding=None if encoding is None else check_depth_encoding(where, encoding),
        frame_id=frame_id,
        background_label=background,
        invalid_values=invalid,
        calibration=calibration,
        camera_name=camera_name,
        folders=folders,
        remarks={key: data[key] for key in _REMARKS if isinstance(data.get(key), str) and data[key]},
    )


@locates_path
def write_capture_camera(path: str | os.PathLike[str], calibration: CaptureCamera) -> None:
    """Write the JSON file from which :func:`read_capture_camera` returns the same numbers.

    Raises:
        CaptureError: there is more than one camera, or the file cannot be written.
    """
    where = f"write_capture_camera: {path}"
    camera = calibration.camera
    k = camera.intrinsics[0].tolist()
    if camera.num_views != 1:
        raise CaptureError(f"{where}: the file describes one camera, got {camera!r}; write one per view")
    data: dict[str, Any] = {"width": camera.size[1], "height": camera.size[0]}
    data |= {"fx": k[0][0], "fy": k[1][1], "cx": k[0][2], "cy": k[1][2]}
    data |= {"skew": k[0][1]} if k[0][1] else {}
    data |= {"is_window": True} if camera.is_window else {}
    if camera.distortion is not None:
        model, data["distortion"] = camera.lenses[0]
        data |= {} if model == "opencv" else {"lens": model}
    data |= {key: value for key, name in _STATED.items() if (value := getattr(calibration, name)) is not None}
    data |= {key: calibration.remarks[key] for key in _REMARKS if key in calibration.remarks}
    with replacing(where, path) as temporary:
        temporary.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


@locates_path
def read_intrinsics(
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int],  # (height, width) of the image they belong to
) -> Camera:
    """Read a 3x3 intrinsics matrix in pixels from a text file, which does not state its image size.

    Raises:
        CaptureError: the file is missing, not nine numbers, or not the intrinsics of an image of this size.
    """
    where = f"read_intrinsics: {path}"
    values = _numbers(where, read_text(where, path))
    if len(values) != 9:
        raise CaptureError(f"{where}: must hold a 3x3 matrix, nine numbers, got {len(values)}")
    fx, skew, cx, zero, fy, cy, *last = values
    if skew != 0 or zero != 0 or last != [0.0, 0.0, 1.0]:
        raise CaptureError(
            f"{where}: must be fx 0 cx / 0 fy cy / 0 0 1, got {values}; is it transposed, or a 3x4 projection matrix?"
        )
    return _camera(where, fx=fx, fy=fy, cx=cx, cy=cy, size=size)


@locates_path
def read_pose(path: str | os.PathLike[str]) -> Tensor:  # (4, 4) float64
    """Read a rigid 4x4 pose from text (16 numbers, row by row) or ``.npy``. Its direction is the caller's to know.

    Raises:
        CaptureError: the file is missing, or not a 4x4 matrix of numbers.
        PoseError: the matrix is not rigid, or has NaN or infinite values (tracking lost).
    """
    where = f"read_pose: {path}"
    if Path(path).suffix.lower() == ".npy":
        matrix = map_npy(where, path, max_bytes=4096)
        if matrix.shape != (4, 4) or matrix.dtype.kind not in "fiu":
            raise CaptureError(f"{where}: a pose must be a (4, 4) array of numbers, got {matrix.dtype} {matrix.shape}")
        pose = torch.from_numpy(matrix.astype(np.float64))
    else:
        values = _numbers(where, read_text(where, path))
        if len(values) != 16:
            raise CaptureError(
                f"{where}: a pose must be 4x4, sixteen numbers row by row, got {len(values)}"
                f"{_SHORT_POSES.get(len(values), '')}"
            )
        pose = torch.tensor(values, dtype=torch.float64, device="cpu").reshape(4, 4)
    rigid.check_rigid(where, pose)
    return pose


@locates_path
def write_pose(path: str | os.PathLike[str], pose: Tensor) -> None:
    """Write a rigid (4, 4) pose as text that :func:`read_pose` reads back exactly."""
    where = f"write_pose: {path}"
    if tuple(pose.shape) != (4, 4):
        raise PoseError(f"{where}: one pose is (4, 4), got {tuple(pose.shape)}")
    rigid.check_rigid(where, pose)
    rows = "\n".join(" ".join(map(repr, row)) for row in pose.double().tolist())
    with replacing(where, path) as temporary:
        temporary.write_text(rows + "\n", encoding="utf-8")


def _camera(where: str, *, skew: float = 0.0, is_window: bool = False, **values: Any) -> Camera:
    try:
        if not skew and not is_window:
            return Camera.pinhole(**values)
        fx, fy, cx, cy = (values[name] for name in ("fx", "fy", "cx", "cy"))
        lens = values.get("distortion")
        return Camera.from_dict(
            {
                "intrinsics": [[[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]],
                "size": values["size"],
                "distortion": None if lens is None else [lens],
                "is_window": is_window,
            }
        )
    except PcdataError as error:
        raise IntrinsicsError(f"{where}: {error}") from error


def _check_keys(where: str, data: dict[str, Any]) -> None:
    known = (*_REQUIRED, "skew", "is_window", "distortion", "lens", *_STATED, *_REMARKS)
    faults = [f"{key!r} is missing" for key in _REQUIRED if key not in data]
    for key in data:
        if key not in known:
            hint = _HINTS.get(key.lower())
            faults.append(f"{key[:60]!r} is not known{'; ' + hint if hint else near_matches(key, known)}")
    if faults:
        more = f" and {len(faults) - _SHOWN} more" if len(faults) > _SHOWN else ""
        raise CaptureError(f"{where}: {', '.join(faults[:_SHOWN])}{more}")


def _name(where: str, data: dict[str, Any], key: str) -> str | None:
    value = data.get(key)
    if value is not None and (not isinstance(value, str) or not value.strip()):
        raise CaptureError(f'{where}: {key!r} must be a name such as "base", got {value!r:.80}')
    return value


def _number(where: str, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise CaptureError(f"{where}: {key!r} must be a number, got {value!r:.80}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise CaptureError(f"{where}: {key!r} must be a finite number")
    return number


def _whole(where: str, data: dict[str, Any], key: str) -> int:
    number = _number(where, key, data[key])
    if number != int(number) or not 1 <= number <= 1 << 16:
        raise CaptureError(f"{where}: {key!r} must be a whole number of pixels, got {data[key]!r:.80}")
    return int(number)


def _distortion(where: str, value: Any, lens: Any) -> list[float] | None:
    if lens is not None and (not isinstance(lens, str) or model_named(lens) is None):
        raise CaptureError(f"{where}: 'lens' must be one of {', '.join(LENS_MODELS)}, got {lens!r:.80}")
    model = "opencv" if lens is None else str(model_named(lens))
    if (value is None or value == []) and lens is None:
        return None
    counts = LENS_MODELS[model][1]
    if not isinstance(value, list) or len(value) not in counts:
        order = "OpenCV order k1 k2 p1 p2 k3 ..." if model == "opencv" else f"of the lens {model}"
        raise CaptureError(
            f"{where}: 'distortion' must be a list of {', '.join(map(str, counts))} numbers ({order}), got "
            f"{value!r:.200}"
        )
    return lens_row(where, model, [_number(where, "distortion", entry) for entry in value])


def _numbers(where: str, text: str) -> list[float]:
    words = text.replace(",", " ").split()
    try:
        return [number_of(word) for word in words[:100]]
    except ValueError as error:
        raise CaptureError(f"{where}: must hold numbers only: {str(error)[:200]}") from error
