"""The depth image that an organized cloud still lies on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.host import rising
from pcdata.contracts.known import RIGID, is_known, note
from pcdata.contracts.on_host import on_host
from pcdata.errors import ConfigError, DeviceError, DTypeError, ShapeError
from pcdata.functional.rows import counts_from_ptr
from pcdata.geometry.rigid import are_few_and_rigid

# Kernels number the pixels of an image, with a margin around it, in 63 bits.
_MOST_PIXELS = 2**31 - 1
# An image has lines of missing pixels where every so many-th point is before one. Depth that was moved to the image of
# another camera, and is sparser there, has 0.2 and more; other holes are rarely one pixel wide.
_LINED = 0.05
# Of the entries of rotation^T rotation: kernels allow for motions that stretch lengths by up to 5e-5.
_MOST_OFF = 2e-5


@dataclass(frozen=True)
class ImageGrid:
    """Where each point of a packed batch sits in its view's depth image.

    Operations that take a grid give the same answer without it; it lets a kernel search a window of pixels instead of
    space. That is fast while the points are the back-projection of those pixels, up to a rigid motion that
    ``camera_from_points`` undoes. It is never wrong: kernels prove each window from the points themselves, so a grid
    that does not fit (points denoised, jittered or scaled since, a forgotten motion, a lens that bends the rows) only
    loses the speed. Points that were masked out are no points: leave their pixels out too.
    """

    pixel_index: Tensor  # (N,) int64, v * width + u within the cloud's own image, increasing within a cloud
    size: tuple[int, int]  # (height, width) of every image
    intrinsics: Tensor  # (B, 3, 3) pixels
    camera_from_points: Tensor | None = None  # (B, 4, 4) float, rigid; None = points are in their cameras' frames


def checked_grid(where: str, name: str, arguments: Mapping[str, Any]) -> ImageGrid:
    """Require that an image grid describes exactly the points of the call: a kernel will trust it.

    Raises:
        ShapeError: its pixels are not one per point, increasing within each cloud and inside the image, or its
            intrinsics or motions are not one per cloud, or the image is no image.
        DTypeError: its pixels are not int64.
        ConfigError: ``camera_from_points`` is not rigid.
        DeviceError: it is on another device.
    """
    grid: ImageGrid = arguments[name]
    points, ptr = arguments["points"], arguments["ptr"]
    pixel, (height, width) = grid.pixel_index, grid.size
    if pixel.dtype is not torch.int64:
        raise DTypeError(f"{where}: grid.pixel_index must be int64, not {pixel.dtype}; convert it with .long()")
    if not (height >= 0 and width >= 0 and height * width <= _MOST_PIXELS):
        raise ShapeError(
            f"{where}: grid.size must be (height, width) of at most {_MOST_PIXELS} pixels in all, got {grid.size}"
        )
    if pixel.device != points.device:
        raise DeviceError(f"{where}: grid is on {pixel.device} but points is on {points.device}; move one with .to()")
    if pixel.shape != points.shape[:1] or grid.intrinsics.shape != (ptr.shape[0] - 1, 3, 3):
        raise ShapeError(
            f"{where}: grid has {tuple(pixel.shape)} pixels and {tuple(grid.intrinsics.shape)} intrinsics for "
            f"{len(points)} points in {len(ptr) - 1} clouds; drop the grid, or select it together with the points"
        )
    if grid.camera_from_points is not None:
        _check_rigid(where, grid.camera_from_points, ptr.shape[0] - 1, points.device)
    fact = pixels_rise(grid.size)
    if pixel.shape[0] == 0 or is_known(fact, pixel, ptr):
        return grid
    filled = counts_from_ptr(ptr) > 0
    first, last = ptr[:-1][filled], ptr[1:][filled] - 1
    # Where pixels rise, only the ends of a cloud can lie outside the image.
    if not rising(pixel, ptr) or int(pixel[first].min()) < 0 or int(pixel[last].max()) >= height * width:
        raise ShapeError(
            f"{where}: grid pixels must increase within each cloud and lie in 0..{height * width - 1}; "
            "the points were reordered or repeated since they were read, so pass grid=None"
        )
    note(fact, pixel, ptr)
    return grid


def pixels_rise(size: tuple[int, int]) -> tuple[str, int, int]:
    """Name the fact that pixels, with row pointers, are those of images of this size: see ``contracts.known``."""
    return ("pixels rise", *size)


def _check_rigid(where: str, motion: Tensor, num_clouds: int, device: torch.device) -> None:
    name = f"{where}: grid.camera_from_points"
    if motion.shape != (num_clouds, 4, 4):
        raise ShapeError(f"{name} must be ({num_clouds}, 4, 4), one per cloud, got {tuple(motion.shape)}")
    if motion.device != device:
        raise DeviceError(f"{name} is on {motion.device} but points is on {device}; move one with .to()")
    if is_known(RIGID, motion):
        return
    if are_few_and_rigid(motion, tolerance=_MOST_OFF):
        return note(RIGID, motion)
    wide = on_host(motion).double()
    rotation, last = wide[:, :3, :3], wide[:, 3]
    off = (rotation.mT @ rotation - torch.eye(3, dtype=wide.dtype, device="cpu")).abs().amax((1, 2))
    off = torch.maximum(off, (last - last.new_tensor([0.0, 0.0, 0.0, 1.0])).abs().amax(1))
    # NaN fails too.
    wrong = (~(off <= _MOST_OFF) | ~torch.isfinite(wide).all(2).all(1)).nonzero().squeeze(1).tolist()
    if wrong:
        raise ConfigError(
            f"{name}[{wrong[0]}] is not rigid: rotation^T rotation is off the identity by {float(off[wrong[0]]):.2g}; "
            "a window of a scaled or sheared cloud proves nothing, so pass grid=None"
        )
    note(RIGID, motion)


def is_lined(pixel_index: Tensor, size: tuple[int, int]) -> bool:
    """Say whether lines of single missing pixels run through an image of points on pixels (n,)."""
    if len(pixel_index) == 0:
        return False
    there = torch.zeros(size, dtype=torch.bool, device=pixel_index.device)
    there.view(-1)[pixel_index] = True
    across = there[:, :-2] & ~there[:, 1:-1] & there[:, 2:]
    down = there[:-2] & ~there[1:-1] & there[2:]
    return int(across.sum()) + int(down.sum()) > _LINED * len(pixel_index)
