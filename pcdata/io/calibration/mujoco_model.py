"""The cameras of a MuJoCo model file: field of view, and the pose of those that stand still; the planes of its depth.

Source: MuJoCo, XML reference: ``camera`` (fovy in degrees whatever the compiler says, 45 where it is not said; looks
along -z with y up), ``statistic extent``, ``visual map`` (znear 0.01, zfar 50 where they are not said, times extent).
"""

from __future__ import annotations

import math
from typing import NamedTuple
from xml.etree import ElementTree

import torch
from torch import Tensor

from pcdata.errors import CaptureError
from pcdata.files.xml import xml_root
from pcdata.geometry.camera_axes import CAMERA_AXES
from pcdata.geometry.rigid import from_rotation_translation
from pcdata.geometry.rotations import rotation_from_quaternion

_MAX_DEPTH = 200  # of elements within elements: a robot's bodies reach 30


class _MujocoCamera(NamedTuple):
    """What a model says of one camera."""

    fovy: float | None  # degrees, vertical; None = not said here
    pose: Tensor | None  # (4, 4) float64, world from a camera with OpenCV's axes; None = on a body that moves


class MujocoModel(NamedTuple):
    """What a model says of rendering."""

    cameras: dict[str, _MujocoCamera]
    near: float | None  # metres; None = the extent is not said, which the compiler computes
    far: float | None


def read_mujoco_model(where: str, text: str) -> MujocoModel:
    """Read the text of a model.

    Raises:
        CaptureError: it is no XML, has a document type (entities may stand for gigabytes), or numbers are none.
    """
    root = xml_root(where, text)
    extent = _number(where, root.find("statistic"), "extent")
    planes = root.find("visual/map")
    near = None if extent is None else extent * (_number(where, planes, "znear") or 0.01)
    far = None if extent is None else extent * (_number(where, planes, "zfar") or 50.0)
    cameras: dict[str, _MujocoCamera] = {}
    for world in root.iter("worldbody"):
        waiting = [(world, True, 0)]
        while waiting:
            element, stands, depth = waiting.pop()
            if depth > _MAX_DEPTH:
                raise CaptureError(f"{where}: has bodies within bodies more than {_MAX_DEPTH} deep")
            for inner in element:
                if inner.tag == "camera" and (name := inner.get("name")):
                    cameras[name] = _camera(f"{where}: camera {name!r:.80}", inner, stands)
                elif inner.tag in ("body", "frame", "replicate"):
                    waiting.append((inner, False, depth + 1))
    return MujocoModel(cameras, near, far)


def _camera(where: str, element: ElementTree.Element, stands: bool) -> _MujocoCamera:
    fovy = _number(where, element, "fovy")
    turned_otherwise = any(element.get(name) is not None for name in ("euler", "xyaxes", "zaxis", "axisangle"))
    if not stands or turned_otherwise or element.get("mode", "fixed") != "fixed":
        return _MujocoCamera(fovy, None)
    position = torch.tensor(_numbers(where, element, "pos", "0 0 0", 3), dtype=torch.float64, device="cpu")
    quaternion = torch.tensor(_numbers(where, element, "quat", "1 0 0 0", 4), dtype=torch.float64, device="cpu")
    if not float(quaternion.norm()) > 0:
        raise CaptureError(f"{where}: the quaternion is 0")
    pose = from_rotation_translation(rotation_from_quaternion(quaternion / quaternion.norm()), position)
    return _MujocoCamera(fovy, pose @ CAMERA_AXES["opengl"])


def _number(where: str, element: ElementTree.Element | None, name: str) -> float | None:
    if element is None or element.get(name) is None:
        return None
    return _numbers(where, element, name, "", 1)[0]


def _numbers(where: str, element: ElementTree.Element, name: str, default: str, count: int) -> list[float]:
    text = element.get(name, default)
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError as error:
        raise CaptureError(f"{where}: {name} must be numbers, got {text!r:.80}") from error
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise CaptureError(f"{where}: {name} must be {count} finite numbers, got {text!r:.80}")
    return numbers
