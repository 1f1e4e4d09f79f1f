"""Windows of depth images, and the planes that fit what is seen in them.

Planes are linear in 1/z over the image, so sums over pixels are all that a fit takes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.functional.touching.limits import KINECT_NOISE, Limits


class PixelCamera(NamedTuple):
    """Focal lengths and principal point in pixels of the image at hand."""

    fx: float
    fy: float
    cx: float
    cy: float


def spread(noise: float) -> float:
    """Return how much lengths grow with the noise of 1/z, see :mod:`pcdata.functional.touching.limits`."""
    return math.sqrt(noise / KINECT_NOISE)


def rays(shape: torch.Size, camera: PixelCamera, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return y/z of every row (H, 1) and x/z of every column (1, W)."""
    rows = (torch.arange(shape[0], dtype=torch.float64, device=device) - camera.cy) / camera.fy
    columns = (torch.arange(shape[1], dtype=torch.float64, device=device) - camera.cx) / camera.fx
    return rows[:, None], columns[None]


def in_pixels(length: float, camera: PixelCamera, inverse: Tensor, bounds: tuple[int, int]) -> Tensor:
    """Return how many pixels a length covers at each depth, rounded, within bounds."""
    return (length * camera.fx * inverse + 0.5).floor().clamp(*bounds)


def shifted(image: Tensor, down: int, right: int) -> Tensor:
    """Return the value of the pixel so many rows below and columns to the right; 0 or False beyond the image."""
    height, width = image.shape[:2]
    moved = torch.zeros_like(image)
    top, bottom = max(0, -down), min(height, height - down)
    left, end = max(0, -right), min(width, width - right)
    if bottom > top and end > left:
        moved[top:bottom, left:end] = image[top + down : bottom + down, left + right : end + right]
    return moved


class PlaneSums:
    """Sums over the points of windows, for the least-squares planes of 1/z over pixels."""

    def __init__(self, like: Tensor) -> None:
        self.sums = [torch.zeros_like(like) for _ in range(9)]

    def add(self, weight: Tensor, right: int, down: int, rise: Tensor) -> None:
        """Add pixels at an offset from the middle whose 1/z is higher by ``rise``; the weight is 0 or 1."""
        n, u, v, uu, uv, vv, d, ud, vd = self.sums
        n += weight
        u += weight * right
        v += weight * down
        uu += weight * (right * right)
        uv += weight * (right * down)
        vv += weight * (down * down)
        weighted = weight * rise
        d += weighted
        ud += weighted * right
        vd += weighted * down

    def solved(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the slopes per column and row, the rise in the middle, the mean offset, and where a plane was found.

        Where the points do not span a plane the slopes are 0 and the rise is their mean.
        """
        n, u, v, uu, uv, vv, d, ud, vd = self.sums
        count = n.clamp(min=1)
        mean_u, mean_v, mean_d = u / count, v / count, d / count
        uu, uv, vv = uu - u * mean_u, uv - u * mean_v, vv - v * mean_v
        ud, vd = ud - u * mean_d, vd - v * mean_d
        determinant = uu * vv - uv * uv
        found = (n >= 5) & (determinant > 1e-3 * (uu * vv)) & (determinant > 1e-6)
        safe = torch.where(found, determinant, 1.0)
        right = torch.where(found, (ud * vv - vd * uv) / safe, 0.0)
        down = torch.where(found, (vd * uu - ud * uv) / safe, 0.0)
        return right, down, (mean_d - right * mean_u) - down * mean_v, mean_u, mean_v, found


class Planes(NamedTuple):
    """Planes of 1/z over pixels, one around every pixel."""

    right: Tensor  # (H, W) rise per column
    down: Tensor  # per row
    middle: Tensor  # 1/z of the plane at the pixel
    found: Tensor  # bool


def plane_normal(right: Tensor, down: Tensor, middle: Tensor, x: Tensor, y: Tensor, camera: PixelCamera) -> Tensor:
    """Return (..., 3) unit normals toward the camera of planes of 1/z = middle on the ray (x, y, 1)."""
    along_x, along_y, along_z, length = _across(right, down, middle, x, y, camera)
    safe = torch.where(length > 0, length, 1.0)
    return torch.stack([-along_x / safe, -along_y / safe, -along_z / safe], dim=-1)


def _across(
    right: Tensor, down: Tensor, middle: Tensor, x: Tensor, y: Tensor, camera: PixelCamera
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the vector across a plane, 1/z = vector . ray, away from the camera, and its length."""
    along_x, along_y = right * camera.fx, down * camera.fy
    along_z = (middle - along_x * x) - along_y * y
    return along_x, along_y, along_z, ((along_x * along_x + along_y * along_y) + along_z * along_z).sqrt()


def window_planes(
    inverse: Tensor, there: Tensor, reach: Tensor, camera: PixelCamera, noise: float, limits: Limits
) -> Planes:
    """Fit a plane around every pixel to what can be of its face: every second pixel of rows and columns in reach."""
    sums = PlaneSums(inverse)
    gate, steepness = limits.gate * noise, limits.slope / camera.fx
    farthest = int(reach.max()) // 2 * 2 if inverse.numel() else 0
    for down in range(-farthest, farthest + 1, 2):
        for right in range(-farthest, farthest + 1, 2):
            other = shifted(inverse, down, right)
            rise = other - inverse
            allowed = gate + (steepness * math.sqrt(right * right + down * down)) * inverse
            weight = there & (other > 0) & (reach >= max(abs(down), abs(right))) & (rise.abs() < allowed)
            sums.add(weight.to(inverse.dtype), right, down, rise)
    right_slope, down_slope, middle, _, _, found = sums.solved()
    return Planes(right_slope, down_slope, inverse + middle, found & there)


def is_steep(planes: Planes, x: Tensor, y: Tensor, camera: PixelCamera, limits: Limits) -> Tensor:
    """Say where a plane leans more from facing the camera than any surface that is followed."""
    length = _across(planes.right, planes.down, planes.middle, x, y, camera)[3]
    ray = ((x * x + y * y) + 1).sqrt()
    least = 1 / math.sqrt(1 + limits.slope * limits.slope)
    return planes.found & (planes.middle < (least * length) * ray)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Multiply vectors (..., 3), in the order in which kernels add."""
    x, y, z = (a * b).unbind(-1)
    return (x + y) + z


def length(vectors: Tensor) -> Tensor:
    """Return the lengths of vectors (..., 3)."""
    return dot(vectors, vectors).sqrt()
