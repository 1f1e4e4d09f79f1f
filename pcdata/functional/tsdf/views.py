"""One view, prepared for integration: its camera, and images of depth, weight, color and label."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.fields import Fields, Several
from pcdata.contracts.on_host import on_host
from pcdata.errors import CaptureError
from pcdata.functional.tsdf.blocks import COLOR_SCALE
from pcdata.geometry import rigid
from pcdata.geometry.lens import fold_radius

Weighting = Literal["constant", "inverse_square", "angle"]
Carving = Literal["never", "near", "everywhere"]  # see structures.TSDFVolume

UNIT_WEIGHT = 64  # steps of the weight 1, where weights are not all 1
_STEEPEST = 0.1  # the least weight by angle: a surface seen at 84 degrees or more


@dataclass(frozen=True, eq=False)
class FusionView:
    """What one camera saw, in the form that the kernels read."""

    depth: Tensor  # (H, W) float32 metres, 0 = no reading
    rays: Tensor  # (2, H, W) float32, x/z and y/z of every pixel
    pinhole: tuple[float, float, float, float, float]  # fx, skew, cx, fy, cy
    distortion: Tensor | None  # (12,) float64 coefficients; (14,) or (16,) of other lenses
    world_from_camera: Tensor  # (4, 4) float64
    weight: Tensor | None = None  # (H, W) int32 at least 1; None = 1 everywhere
    color: Tensor | None = None  # (H, W) int32: r | g << 10 | b << 20, in steps of a stored color
    label: Tensor | None = None  # (H, W) int32
    unfit: Tensor | None = None  # (1,) bool: whether a label does not fit, not yet read; None = all do

    @property
    def camera_from_world(self) -> Tensor:
        """The pose the other way, (4, 4) float64, on the host."""
        return rigid.invert_rigid(on_host(self.world_from_camera))

    @property
    def fold(self) -> float:
        """The squared radius from which on the lens model folds back; infinite without a lens."""
        return float("inf") if self.distortion is None else float(fold_radius(on_host(self.distortion)[None])) ** 2


_NUMBERS = {"distortion": "D : float64", "world_from_camera": "4 4 : float64"}
_TENSORS = {
    "depth": "H W",
    "rays": "2 H W",
    "weight": "H W : int32",
    "color": "H W : int32",
    "label": "H W : int32",
    "unfit": "1 : bool",
}
# The spec of a view, and of several: what kernels read.
VIEW = Fields(FusionView, numbers=_NUMBERS, **_TENSORS)
VIEWS = Several(VIEW)


@op(colors="H W 3 : uint8", gradient=False)
def pack_colors(
    colors: Tensor,  # (H, W, 3) uint8 RGB
    *,
    backend: str = "auto",
) -> Tensor:  # (H, W) int32
    """Pack colors into one number each, as voxels store them."""
    r, g, b = (colors.int() * COLOR_SCALE).unbind(-1)
    return r | (g << 10) | (b << 20)


def check_labels(labels: Tensor) -> None:
    """Hold int64 labels of the host to the 32 bits of a voxel.

    Raises:
        CaptureError: one does not fit.
    """
    found = labels.numpy()  # see pcdata.contracts.tensors on NumPy
    refuse_labels(int(found.min()) < -(2**31) or int(found.max()) >= 2**31)


def refuse_labels(lack: bool) -> None:
    """Refuse labels if some did not fit."""
    if lack:
        raise CaptureError("TSDFVolume: labels must fit 32 bits; number the objects anew")


def pack_labels(labels: Tensor) -> Tensor:
    """Convert int64 labels that fit to int32, as voxels store them."""
    if labels.device.type == "cpu":
        return torch.from_numpy(labels.numpy().astype(np.int32))
    return labels.int()


def weight_image(
    depth: Tensor,  # (H, W) float32
    rays: Tensor,  # (H, W, 2) float64
    weighting: Weighting,
) -> Tensor | None:  # (H, W) int32, in steps of 1/64; None = 1 everywhere
    """Say how much every reading counts.

    ``inverse_square`` is ``(1 m / depth)^2``, the inverse variance of a sensor whose noise grows with the depth;
    ``angle`` the cosine between the ray and the surface's normal, 0.1 where neighbors without reading hide it.
    """
    if weighting == "constant":
        return None
    if weighting == "inverse_square":
        weight = 1.0 / depth.double().square().clamp(min=1e-4)
    else:
        weight = _cosines(depth, rays)
    return (weight * UNIT_WEIGHT).round().clamp(1, 1 << 14).int()


def _cosines(depth: Tensor, rays: Tensor) -> Tensor:
    """Return |cos| between every pixel's ray and the normal from its four neighbors (H, W) float64."""
    ones = torch.ones_like(rays[..., :1])
    directions = torch.cat([rays, ones], dim=-1).nan_to_num()
    points = directions * depth.double()[..., None]
    cosine = torch.full(depth.shape, _STEEPEST, dtype=torch.float64, device=depth.device)
    if min(depth.shape) < 3:
        return cosine
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    read = depth > 0
    known = read[1:-1, 2:] & read[1:-1, :-2] & read[2:, 1:-1] & read[:-2, 1:-1]
    normal = torch.nn.functional.normalize(torch.linalg.cross(across, down), dim=-1)
    facing = (normal * torch.nn.functional.normalize(directions[1:-1, 1:-1], dim=-1)).sum(-1).abs()
    cosine[1:-1, 1:-1] = torch.where(known, facing.clamp(min=_STEEPEST), _STEEPEST)
    return cosine
