"""What renderers do otherwise with images: rows from the bottom, and pixels counted from corners."""

from __future__ import annotations

from torch import Tensor

from pcdata.structures import Camera
from pcdata.structures.structure import derived

ROWS = ("top_first", "bottom_first")
_CORNER = 0.5  # pixels from the corner of a pixel to its center


def upright_image(image: Tensor, rows: str) -> Tensor:  # (V, H, W, ...)
    """Return images whose first row is the top one."""
    return image.flip(1) if rows == "bottom_first" else image


def centered_camera(camera: Camera) -> Camera:
    """Return a camera whose principal point counts from the corner of the first pixel, counted from its center."""
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, :2, 2] -= _CORNER
    return derived(camera, intrinsics=intrinsics)
