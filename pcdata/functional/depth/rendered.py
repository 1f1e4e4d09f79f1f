"""Depth as renderers give it -> z: shares of the range between two planes, and lengths along rays; and back.

A renderer's buffer holds no lengths: 0 is the near plane and 1 the far one, where nothing was hit.

Source: OpenGL 4.6, section 13.8 (perspective division, depth range) for the buffer of perspective views; robosuite,
``get_real_depth_map``; PyRep, ``VisionSensor.capture_depth`` for equal steps.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from pcdata.errors import CaptureError, PcdataError
from pcdata.geometry.lens import undistort_normalized

DepthValues = Literal["z", "ray", "z_buffer", "equal_steps"]
DEPTH_VALUES: dict[DepthValues, str] = {  # in words
    "z": "metres along the optical axis",
    "ray": "metres along the ray of each pixel",
    "z_buffer": "a renderer's buffer of a perspective view: 0 near, 1 far, finer in front",
    "equal_steps": "the share of the way from near to far, in equal steps",
}
BUFFERS: tuple[DepthValues, ...] = ("z_buffer", "equal_steps")
_FAR = 1.0  # of the buffer, where nothing was hit


def z_of_rendered(where: str, values: Tensor, kind: DepthValues, near: float, far: float) -> Tensor:
    """Return float32 metres along the axis of a renderer's shares of a range; the far plane becomes 0, no reading.

    Raises:
        CaptureError: near and far are not 0 < near < far, or the values are no shares, 0 to 1.
    """
    check_planes(where, near, far)
    share = values.double()
    if bool(((share < 0) | (share > _FAR) | share.isnan()).any()):
        low, high = float(share.nan_to_num(torch.inf).min()), float(share.nan_to_num(-torch.inf).max())
        raise CaptureError(
            f"{where}: a renderer's buffer holds shares from 0 to 1, but this one reaches from {low:.4g} to "
            f"{high:.4g}; is the depth in metres already? Say so"
        )
    z = near / (1 - share * (1 - near / far)) if kind == "z_buffer" else near + share * (far - near)
    return torch.where(share < _FAR, z, 0.0).float()


def ray_lengths(size: tuple[int, int], intrinsics: Tensor, distortion: Tensor | None) -> Tensor:  # (V, H, W) float64
    """Return for every pixel how long the ray is that reaches z = 1: lengths along rays divided by it are z.

    Args:
        size: (height, width).
        intrinsics: (V, 3, 3), pixels.
        distortion: (V, D) of the lens, or None.
    """
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64, device="cpu") for n in size), indexing="ij")
    k = intrinsics.double()[:, :, :, None, None]
    xy = torch.stack([(u - k[:, 0, 2]) / k[:, 0, 0], (v - k[:, 1, 2]) / k[:, 1, 1]], dim=-1)  # (V, H, W, 2)
    if distortion is not None:
        xy = undistort_normalized(xy.flatten(1, 2), distortion).reshape(xy.shape)
    return (1 + xy.square().sum(-1)).sqrt()


def check_planes(where: str, near: float, far: float, *, error: type[PcdataError] = CaptureError) -> None:
    """Require the planes between which something was rendered.

    Raises:
        CaptureError: they are not 0 < near < far; or another error that is asked for.
    """
    if not 0 < near < far < math.inf:
        raise error(
            f"{where}: needs the planes between which it was rendered: near and far in metres with 0 < near < far, got "
            f"{near:g} and {far:g} (MuJoCo: znear and zfar times the model's extent)"
        )
