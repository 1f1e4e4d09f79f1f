"""Arrays of images as programs hold them -> the tensors of a capture."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pcdata.errors import CaptureError, DTypeError, IntrinsicsError, ShapeError
from pcdata.structures.camera import MOST_OFF_CENTER, Camera


def image_tensor(
    where: str,
    name: str,
    images: ArrayLike | None,
    size: tuple[int, ...],  # views, height, width
    *,
    dtypes: tuple[str, ...],  # that are taken; the tensor has the first
    channels: tuple[int, ...] = (),
) -> Tensor | None:
    """Copy (H, W, ...) or (V, H, W, ...) images of the depth's size into a tensor with views.

    Raises:
        DTypeError: another dtype.
        ShapeError: another size, or axes in another order.
    """
    if images is None:
        return None
    array = np.asarray(images)
    wanted = (*size, *channels)
    views = array[None] if array.shape == wanted[1:] and size[0] == 1 else array
    if views.shape != wanted:
        raise ShapeError(
            f"{where}: {name} must be {wanted[1:]} or {wanted}, got {array.shape}; "
            f"{_way_out(name, array.shape, wanted)}"
        )
    if array.dtype.name not in dtypes:
        raise DTypeError(f"{where}: {name} must be {' or '.join(dtypes)}, got {array.dtype}; {_CONVERT[name]}")
    return torch.from_numpy(np.array(views, dtype=dtypes[0]))


_CONVERT = {
    "colors": "8-bit RGB: (colors * 255).round().astype(np.uint8) where it is 0..1",
    "labels": "whole numbers, -1 = none: convert it",
    "confidence": "values of Confidence, 0 to 3: translate the sensor's own",
    "mask": "give mask > 0",
}


def _way_out(name: str, given: tuple[int, ...], wanted: tuple[int, ...]) -> str:
    height, width = wanted[1:3]
    if name != "colors":
        return "give it at the depth's pixels"
    if given[-3:] == (3, height, width):
        return "channels come last: np.moveaxis(colors, -3, -1)"
    if given[-3:] == (height, width, 4):
        return "drop the alpha channel: colors[..., :3]"
    if given[-2:] == (height, width):
        return "a gray image has no colors: leave it out"
    return "colors are RGB at the depth's pixels: let the camera's driver align them to the depth, or leave them out"


def camera_of(
    where: str,
    intrinsics: ArrayLike | Camera,
    distortion: ArrayLike | None,
    views: int,
    size: tuple[int, int],  # height, width
) -> Camera:
    """Return the cameras of V images of one size from (3, 3) or (V, 3, 3) matrices, or the camera that was given.

    A matrix does not say which image it belongs to, so its principal point must lie near the middle of this one.

    Raises:
        ShapeError: matrices or coefficients of another shape.
        IntrinsicsError: they belong to another image.
    """
    if isinstance(intrinsics, Camera):
        if distortion is not None:
            raise CaptureError(f"{where}: the camera has its own distortion; leave distortion out")
        if intrinsics.size != size:
            raise IntrinsicsError(
                f"{where}: the camera is of {intrinsics.size} images but depth is {size}, (height, width); if the "
                f"image was resized, give camera.resized({size}), if it was cut, camera.cropped(top, left, {size})"
            )
        return intrinsics
    k = _numbers(where, "intrinsics", intrinsics, (3, 3), views)
    lens = None if distortion is None else _numbers(where, "distortion", distortion, None, views)
    camera = Camera(intrinsics=k, size=size, distortion=lens)
    for view, off in enumerate(camera.off_center()):
        if off > MOST_OFF_CENTER:
            cx, cy = k[view, 0, 2].item(), k[view, 1, 2].item()
            raise IntrinsicsError(
                f"{where}: the principal point of view {view}, ({cx:.1f}, {cy:.1f}), is far from the middle of the "
                f"{size[1]}x{size[0]} depth; such intrinsics belong to an image of about {2 * cx + 1:.0f}x"
                f"{2 * cy + 1:.0f}. Give those of this stream; or the camera of the whole image, "
                f"Camera(...).resized({size}) or .cropped(top, left, {size}); or, where they are right, "
                f"Camera(intrinsics=..., size={size})"
            )
    return camera


def pose_tensor(where: str, poses: ArrayLike | None, views: int) -> Tensor | None:
    """Return (V, 4, 4) float64 from (4, 4) or (V, 4, 4) poses."""
    return None if poses is None else _numbers(where, "world_from_camera", poses, (4, 4), views, may_repeat=False)


def _numbers(
    where: str, name: str, given: ArrayLike, shape: tuple[int, ...] | None, views: int, *, may_repeat: bool = True
) -> Tensor:
    """Return one float64 array of a shape per view; what is given once counts for all views where it may."""
    try:
        array: NDArray[Any] = np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DTypeError(f"{where}: {name} must be numbers, got {type(given).__name__}: {error}") from error
    wanted = array.shape[-1:] if shape is None else shape
    if array.shape == wanted and (may_repeat or views == 1):
        array = np.repeat(array[None], views, axis=0)
    if array.shape != (views, *wanted):
        hint = "; of a projection matrix take [:, :3], of fx, fy, cx, cy make Camera.pinhole(...)"
        raise ShapeError(
            f"{where}: {name} must be {wanted} for one view or {(views, *wanted)}, got {array.shape}"
            f"{hint if name == 'intrinsics' else ''}"
        )
    return torch.from_numpy(array)
