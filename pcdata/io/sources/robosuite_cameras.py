"""What is known of the cameras of a demonstration of robosuite: of its attributes, its model, and what is stated."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from torch import Tensor

from pcdata.errors import CaptureError
from pcdata.io.calibration.foreign_cameras import matrix_of, pinhole, pinhole_of_matrix
from pcdata.io.calibration.mujoco_model import MujocoModel, read_mujoco_model
from pcdata.io.sources.demonstration_file import json_attribute, number_attribute, text_attribute
from pcdata.io.sources.rendered_images import centered_camera
from pcdata.structures import Calibration, Camera

Size = tuple[int, int]  # (height, width)
_MOVES = "eye_in_hand"  # in the names of cameras on a hand


@dataclass(frozen=True, eq=False)
class StatedCameras:
    """What is stated of cameras, besides the file.

    Args:
        numbers: fx, fy, cx, cy of the one camera that is read.
        calibration: of some cameras by name, with poses to ``frame_id`` where it has transforms.
        frame_id: where poses lead to.
        near: metres, where depth is a renderer's buffer.
        far: metres, where depth is a renderer's buffer.
    """

    numbers: tuple[float, float, float, float] | None
    calibration: Calibration | None
    frame_id: str
    near: float | None
    far: float | None


class _KnownCamera(NamedTuple):
    """What is known of one camera."""

    camera: Callable[[Size], Camera] | None  # of an image of this size
    pose: Tensor | None  # (4, 4) float64, where it is


class KnownCameras(NamedTuple):
    """What is known of the cameras of one demonstration."""

    cameras: dict[str, _KnownCamera]
    near: float | None  # metres, the planes between which depth was rendered
    far: float | None


def known_cameras(where: str, group: Any, names: Sequence[str], stated: StatedCameras) -> KnownCameras:
    """Return what is known of some cameras of a demonstration: what is stated, else its attributes, else its model.

    Raises:
        CaptureError, IntrinsicsError, PoseError: an attribute holds what cannot be.
    """
    info = json_attribute(where, group, "camera_info")
    text = text_attribute(where, group, "model_file")
    model = MujocoModel({}, None, None) if text is None else read_mujoco_model(f"{where}: model_file", text)
    near, far = _planes(where, group, model, stated)
    found = {name: _known(f"{where}: camera {name!r:.80}", name, info.get(name), model, stated) for name in names}
    return KnownCameras(found, near, far)


def _known(where: str, name: str, info: Any, model: MujocoModel, stated: StatedCameras) -> _KnownCamera:
    camera: Callable[[Size], Camera] | None = None
    fovy, pose = model.cameras.get(name, (None, None))
    if fovy is not None:
        camera = partial(_of_fovy, fovy=fovy)
    if info is not None:
        camera, own = _of_info(where, name, info)
        pose = pose if own is None else own
    if stated.numbers is not None:
        camera = partial(pinhole, numbers=stated.numbers)
    if (known := stated.calibration) is not None and name in known.cameras:
        camera = partial(_as_calibrated, camera=known.camera(name))
        pose = known.transform(stated.frame_id, name) if known.transforms else pose
    return _KnownCamera(camera, pose)


def _of_info(where: str, name: str, info: Any) -> tuple[Callable[[Size], Camera], Tensor | None]:
    """Read an entry of camera_info.

    Of a camera on a hand its extrinsics are world_from_camera times eef_from_world, which is the pose of nothing.
    """
    if not isinstance(info, Mapping):
        raise CaptureError(f"{where}: camera_info must hold intrinsics and extrinsics, got {info!r:.80}")
    from_corner = pinhole_of_matrix(f"{where}: intrinsics", info.get("intrinsics"))
    rows = info.get("extrinsics")
    if _MOVES in name or rows is None:
        return partial(_centered, from_corner=from_corner), None
    if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
        raise CaptureError(f"{where}: extrinsics must be a 4x4 matrix, got {rows!r:.80}")
    pose = matrix_of(f"{where}: extrinsics", [value for row in rows for value in row])
    return partial(_centered, from_corner=from_corner), pose


def _planes(
    where: str, group: Any, model: MujocoModel, stated: StatedCameras
) -> tuple[float | None, float | None]:  # near, far
    extent, znear, zfar = (number_attribute(where, group, name) for name in ("extent", "znear", "zfar"))
    near = model.near if extent is None or znear is None else extent * znear
    far = model.far if extent is None or zfar is None else extent * zfar
    return near if stated.near is None else stated.near, far if stated.far is None else stated.far


def _of_fovy(size: Size, fovy: float) -> Camera:
    height, width = size
    focal = 0.5 * height / math.tan(math.radians(fovy) / 2)
    return pinhole(size, (focal, focal, (width - 1) / 2, (height - 1) / 2))


def _centered(size: Size, from_corner: Callable[[Size], Camera]) -> Camera:
    return centered_camera(from_corner(size))


def _as_calibrated(size: Size, camera: Camera) -> Camera:
    return camera  # what joins it with an image requires the size
