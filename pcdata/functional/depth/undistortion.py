"""Images as a pinhole camera in the same place would have seen them, the lens taken out.

Source: OpenCV, initUndistortRectifyMap and remap (without rectifying rotation).
"""

from __future__ import annotations

from collections import OrderedDict
from functools import partial
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_image_size, checked_positive, checked_word
from pcdata.errors import CaptureError
from pcdata.functional.depth.deproject import check_intrinsics, pixel_rays
from pcdata.geometry.lens import distort_normalized, fold_radius
from pcdata.geometry.lens_models import check_distortion

_MAPS_KEPT = 8  # 15 MB each at 1280x720: color and depth of the cameras of a usual rig
_maps: OrderedDict[tuple[Any, ...], Tensor] = OrderedDict()


@op(
    image="V H W C : image",
    intrinsics="V 3 3 : float",
    distortion="V D : float",
    new_intrinsics="V 3 3 : float",
    size=checked_image_size,
    rule=partial(checked_word, words=("bilinear", "nearest")),
)
def undistort_image(
    image: Tensor,  # (V, H, W, C) uint8, float32 or float64
    intrinsics: Tensor,  # (V, 3, 3) pixels, of the image
    distortion: Tensor,  # (V, D) lenses, see pcdata.geometry.lens_models
    *,
    new_intrinsics: Tensor | None = None,  # (V, 3, 3) of the result; None = those of the image
    size: tuple[int, int] | None = None,  # (height, width) of the result; None = that of the image
    rule: str = "bilinear",
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # image (V, h, w, C) of the image's dtype; valid (V, h, w) bool
    """Return what a pinhole camera sees, from what the lens let through; 0 and not ``valid`` beyond the image.

    A pixel is ``valid`` where its ray is one that the lens sees and lands within the image (-0.5 .. width - 0.5).
    Bilinear weights are float32; whole numbers are rounded, halves to even.

    Raises:
        CaptureError: impossible intrinsics or distortion.

    Source: OpenCV, initUndistortRectifyMap and remap; its weights are multiples of 1/32, these are exact.
    """
    height, width = image.shape[1:3]
    at = undistortion_map(intrinsics, distortion, new_intrinsics, size or (height, width))
    valid = _within(at, height, width)
    if rule == "nearest" or not image.numel():
        return _picked(image, nearest_pixels(at, valid, height, width)), valid
    work = image.double() if image.dtype is torch.float64 else image.float()
    corners, weights = _corners(at, valid, height, width)
    pixels = work.flatten(1, 2)
    mixed = sum(
        _gathered(pixels, corner) * weight.to(work.dtype)[..., None] for corner, weight in zip(corners, weights)
    )
    assert isinstance(mixed, Tensor)
    mixed = torch.where(valid[..., None], mixed, 0.0)
    if image.dtype is torch.uint8:
        mixed = mixed.round().clamp(0, 255)
    return mixed.to(image.dtype), valid


@op(
    depth="V H W : depth",
    intrinsics="V 3 3 : float",
    distortion="V D : float",
    new_intrinsics="V 3 3 : float",
    size=checked_image_size,
    rule=partial(checked_word, words=("surface", "nearest")),
    max_jump=partial(checked_positive, finite=False),
)
def undistort_depth(
    depth: Tensor,  # (V, H, W) float32 metres, 0 = no reading
    intrinsics: Tensor,  # (V, 3, 3) pixels, of the image
    distortion: Tensor,  # (V, D) lenses, see pcdata.geometry.lens_models
    *,
    new_intrinsics: Tensor | None = None,  # (V, 3, 3) of the result; None = those of the image
    size: tuple[int, int] | None = None,  # (height, width) of the result; None = that of the image
    rule: str = "nearest",
    max_jump: float = 0.02,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # depth (V, h, w) float32; pixel_index (V, h, w) int64
    """Return the depth that a pinhole camera measures; it never blends across an edge.

    A pixel takes the nearest reading, at most half a pixel off; by the rule ``surface``, where the four readings around
    its ray differ by at most ``max_jump`` times the nearest, the mean of their inverse depths, which is linear on
    planes. No reading there, or none of the lens, is 0.

    ``pixel_index`` is the nearest pixel ``v * W + u``, from which labels may follow; -1 beyond the image.

    Raises:
        CaptureError: a negative depth, impossible intrinsics or distortion.

    Source: see :func:`undistort_image`.
    """
    height, width = depth.shape[1:]
    at = undistortion_map(intrinsics, distortion, new_intrinsics, size or (height, width))
    valid = _within(at, height, width)
    pixel_index = nearest_pixels(at, valid, height, width)
    nearest = _picked(depth[..., None], pixel_index)[..., 0]
    if rule == "nearest" or not depth.numel():
        return nearest, pixel_index
    corners, weights = _corners(at, valid, height, width)
    around = torch.stack([_gathered(depth.flatten(1)[..., None], corner)[..., 0] for corner in corners])
    low, high = around.amin(0), around.amax(0)
    one_surface = (low > 0) & (high - low <= max_jump * low) & valid & (nearest > 0)
    known = torch.where(one_surface, around, 1.0)
    parts = weights.float() / known
    inverse = ((parts[0] + parts[1]) + parts[2]) + parts[3]  # in this order on all backends
    return torch.where(one_surface, 1.0 / inverse, nearest), pixel_index


def undistortion_map(
    intrinsics: Tensor,  # (V, 3, 3) of the image
    distortion: Tensor,  # (V, D)
    new_intrinsics: Tensor | None,  # (V, 3, 3) of the result
    size: tuple[int, int],  # (height, width) of the result
) -> Tensor:  # (V, h, w, 2) float64
    """Return where in the image (u, v) each pixel of the result is seen; NaN where the lens does not see its ray.

    The last maps are kept by the numbers of the cameras, their sizes and device; a map with a gradient never is.

    Raises:
        CaptureError: impossible intrinsics or distortion.
    """
    where = "undistortion_map"
    check_distortion(where, distortion)
    new = intrinsics if new_intrinsics is None else new_intrinsics
    parts = (intrinsics, distortion, new)
    if torch.is_grad_enabled() and any(part.requires_grad for part in parts):
        return _mapped(intrinsics, distortion, new, size)
    key = (size, intrinsics.device, *((part.shape, *part.flatten().tolist()) for part in parts))
    if key not in _maps:
        check_intrinsics(where, intrinsics)
        _maps[key] = _mapped(intrinsics.detach(), distortion.detach(), new.detach(), size)
        while len(_maps) > _MAPS_KEPT:
            _maps.popitem(last=False)
    _maps.move_to_end(key)
    return _maps[key]


def nearest_pixels(at: Tensor, valid: Tensor, height: int, width: int) -> Tensor:  # (V, h, w) int64
    """Return the pixel ``v * width + u`` that is nearest to every place; -1 where there is none."""
    u, v = (at.detach().nan_to_num() + 0.5).floor().long().unbind(-1)
    return torch.where(valid, v.clamp(0, height - 1) * width + u.clamp(0, width - 1), -1)


def _mapped(intrinsics: Tensor, distortion: Tensor, new: Tensor, size: tuple[int, int]) -> Tensor:
    rays = pixel_rays(new, size)
    seen = rays.norm(dim=-1) < fold_radius(distortion)[:, None, None]
    x, y = distort_normalized(torch.where(seen[..., None], rays, 0.0), distortion).unbind(-1)
    k = intrinsics.double()[:, :, :, None, None]
    at = torch.stack([k[:, 0, 0] * x + k[:, 0, 1] * y + k[:, 0, 2], k[:, 1, 1] * y + k[:, 1, 2]], dim=-1)
    return torch.where(seen[..., None], at, torch.nan)


def _within(at: Tensor, height: int, width: int) -> Tensor:
    u, v = at.unbind(-1)
    return (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)


def _corners(at: Tensor, valid: Tensor, height: int, width: int) -> tuple[list[Tensor], Tensor]:
    """Return the four pixels around every place, each (V, h, w) int64, and their weights (4, V, h, w) float64."""
    place = torch.where(valid[..., None], at, 0.0)
    u, v = place[..., 0].clamp(0, width - 1), place[..., 1].clamp(0, height - 1)
    left, top = u.detach().floor().clamp(max=max(width - 2, 0)), v.detach().floor().clamp(max=max(height - 2, 0))
    across, down = u - left, v - top
    columns = [left.long(), (left.long() + 1).clamp(max=width - 1)]
    rows = [top.long(), (top.long() + 1).clamp(max=height - 1)]
    corners = [row * width + column for row in rows for column in columns]
    weights = [y * x for y in (1 - down, down) for x in (1 - across, across)]
    return corners, torch.stack(weights)


def _gathered(pixels: Tensor, index: Tensor) -> Tensor:
    """Return (V, h, w, C) of pixels (V, P, C)."""
    flat = index.flatten(1)[..., None].expand(-1, -1, pixels.shape[-1])
    return pixels.gather(1, flat).reshape(*index.shape, pixels.shape[-1])


def _picked(image: Tensor, pixel_index: Tensor) -> Tensor:
    """Return the pixels of (V, H, W, C) at an index (V, h, w); 0 where that is -1."""
    if not image.flatten(1, 2).shape[1]:
        raise CaptureError("undistort: the images have no pixel")
    found = _gathered(image.flatten(1, 2), pixel_index.clamp(min=0))
    return torch.where((pixel_index >= 0)[..., None], found, torch.zeros((), dtype=image.dtype, device=image.device))
