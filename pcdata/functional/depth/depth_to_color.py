"""Depth registered to color: what the color camera would measure, from what the depth camera did."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_image_size, checked_positive
from pcdata.errors import CaptureError
from pcdata.functional.depth.deproject import check_intrinsics, check_rays, pixel_rays
from pcdata.functional.depth.splatting import (
    MAX_PIXELS,
    cell_of_pixels,
    empty_image,
    on_one_surface,
    paint,
    painted,
)
from pcdata.geometry import rigid
from pcdata.geometry.lens import distort_normalized, fold_radius
from pcdata.geometry.lens_models import check_distortion

_BAND = 1 << 16  # pixels handled at once on a CPU: the dozens of intermediate images stay in a core's cache


class RegisteredDepth(NamedTuple):
    """Depth in the color image, and who hides whom."""

    depth: Tensor  # (V, Hc, Wc) float32 metres along the color camera's z, 0 = no reading
    pixel_index: Tensor  # (V, Hc, Wc) int64: the pixel v * W + u of the depth image it comes from, -1 = none
    occluding: Tensor  # (V, Hc, Wc) bool: a farther reading was hidden here by this nearer surface
    hidden: Tensor  # (V, H, W) bool: a reading that the color camera does not see; it must not take its color there


class _View(NamedTuple):
    """One view's depth image and both cameras."""

    depth: Tensor  # (H, W)
    rays: tuple[Tensor, Tensor]  # x/z and y/z of the depth camera, each (H, W) float32
    half_pixel: Tensor  # (2,), see half_pixels
    color_intrinsics: Tensor  # (3, 3)
    color_from_depth: Tensor  # (4, 4)
    color_distortion: Tensor | None  # (E,)


class _Projection(NamedTuple):
    """Where the color camera sees some rows of depth pixels; each (h, W)."""

    u: Tensor
    v: Tensor
    depth: Tensor  # float32, metres along the color camera's z
    visible: Tensor  # bool: has a reading, lies before the camera and within the lens model


@op(
    depth="V H W : depth",
    intrinsics="V 3 3 : float",
    color_intrinsics="V 3 3 : float",
    color_from_depth="V 4 4 : float64",
    distortion="V D : float",
    color_distortion="V E : float",
    color_size=checked_image_size,
    max_jump=partial(checked_positive, finite=False),
    gradient=False,
)
def register_depth(
    depth: Tensor,  # (V, H, W) float32 metres, 0 = no reading
    intrinsics: Tensor,  # (V, 3, 3) of the depth camera
    color_intrinsics: Tensor,  # (V, 3, 3) of the color camera, at color_size
    color_from_depth: Tensor,  # (V, 4, 4) float64 rigid
    *,
    color_size: tuple[int, int],  # (height, width)
    distortion: Tensor | None = None,  # (V, D) of the depth camera
    color_distortion: Tensor | None = None,  # (V, E) of the color camera
    max_jump: float = 0.02,
    backend: str = "auto",
) -> RegisteredDepth:
    """Render the depth readings as the color camera sees them, nearest first, without cracks.

    Every reading covers a cell of the color image: the box around its four corners. Where the four pixels around a
    corner lie on one surface (depths within ``max_jump`` of the nearest), the corner is the mean of their projections,
    shared by all four: their cells leave no crack, whatever the sizes of the images. At an edge or a hole a pixel ends
    half a pixel from its center. A color pixel takes the nearest of the readings whose cells hold its center (of
    equally near ones the first); nothing is interpolated.

    A reading is ``hidden`` if it projects outside the image, or onto a surface nearer by more than ``max_jump``.

    Raises:
        CaptureError: a negative depth, impossible intrinsics or distortion, or a reading where a lens has no inverse.
        PoseError: color_from_depth is not rigid.
        ConfigError: a size below one pixel or a jump that is not positive.

    Source: the z-buffer is as old as Catmull, 1974; librealsense's align draws the same boxes, but per pixel, so
    slanted surfaces crack.
    """
    check_cameras(depth, intrinsics, distortion, color_intrinsics, color_distortion, color_from_depth)
    rays = pixel_rays(intrinsics, (depth.shape[1], depth.shape[2]), distortion)
    check_rays("register_depth", rays, depth > 0)
    halves = half_pixels(intrinsics, color_intrinsics, color_from_depth)
    lenses = [None] * len(depth) if color_distortion is None else color_distortion.unbind(0)
    x, y = (part.contiguous() for part in rays.float().unbind(-1))
    views = zip(depth, zip(x, y), halves, color_intrinsics.double(), color_from_depth, lenses)
    results = [_register_view(_View(*view), color_size, max_jump) for view in views]
    if not results:
        none = torch.empty((0, *color_size), dtype=torch.float32, device=depth.device)
        return RegisteredDepth(none, none.long(), none.bool(), torch.zeros_like(depth, dtype=torch.bool))
    return RegisteredDepth(*(torch.stack(images) for images in zip(*results, strict=True)))


def check_cameras(
    depth: Tensor,
    intrinsics: Tensor,
    distortion: Tensor | None,
    color_intrinsics: Tensor,
    color_distortion: Tensor | None,
    color_from_depth: Tensor,
) -> None:
    """Refuse what :func:`register_depth` says it refuses, but for rays that a lens does not have."""
    where = "register_depth"
    for matrix, lens in ((intrinsics, distortion), (color_intrinsics, color_distortion)):
        check_intrinsics(where, matrix)
        if lens is not None:
            check_distortion(where, lens)
    rigid.check_rigid(f"{where}: color_from_depth", color_from_depth)
    if depth.shape[1] * depth.shape[2] > MAX_PIXELS:
        raise CaptureError(f"{where}: depth images of more than {MAX_PIXELS} pixels are not supported")


def half_pixels(intrinsics: Tensor, color_intrinsics: Tensor, color_from_depth: Tensor) -> Tensor:
    """Return (V, 2) float64: half the width and height, in color pixels, of the box around a depth pixel.

    It is that of a pixel that faces its camera and is as far from both; it grows with the depth in the depth camera
    over the depth in the color camera.
    """
    focal, color_focal = (k.double().diagonal(dim1=1, dim2=2)[:, :2] for k in (intrinsics, color_intrinsics))
    return 0.5 * ((color_from_depth[:, :2, :2].abs() / focal[:, None]).sum(2) * color_focal)


def _register_view(view: _View, size: tuple[int, int], max_jump: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    image = empty_image(size, view.depth.device)
    height, width = view.depth.shape
    projections = []
    for start, stop in _bands(view.depth):
        # One more row on each side: the corners of a pixel depend on its neighbors.
        first, last = max(0, start - 1), min(height, stop + 1)
        rows = slice(start - first, stop - first)
        seen = _project(view, first, last)
        linked = on_one_surface(torch.where(seen.visible, view.depth[first:last], 0.0), max_jump)
        nearness = view.depth[first:last] / seen.depth
        half_width, half_height = view.half_pixel.tolist()
        left, right = cell_of_pixels(seen.u, half_width * nearness, linked)
        top, bottom = cell_of_pixels(seen.v, half_height * nearness, linked)
        cells = (left[rows], right[rows], top[rows], bottom[rows])
        paint(image, seen.depth[rows], seen.visible[rows], cells, first_index=start * width)
        projections.append(_Projection(*(column[rows] for column in seen)))
    registered, pixel_index = painted(image)

    hidden = torch.empty_like(view.depth, dtype=torch.bool)
    occluding = torch.zeros(registered.numel(), dtype=torch.bool, device=registered.device)
    for (start, stop), seen in zip(_bands(view.depth), projections, strict=True):
        outside, behind, target = _behind(seen, registered, max_jump)
        hidden[start:stop] = (view.depth[start:stop] > 0) & (outside | behind)
        occluding[target[behind]] = True
    return registered, pixel_index, occluding.reshape(size), hidden


def _bands(image: Tensor) -> Iterator[tuple[int, int]]:
    """Yield the first row of every band and the row after its last."""
    height, width = image.shape
    rows = max(1, _BAND // max(1, width)) if image.device.type == "cpu" else max(1, height)
    return ((start, min(height, start + rows)) for start in range(0, height, rows))


def _project(view: _View, first: int, last: int) -> _Projection:
    """Move the readings of some rows into the color camera and project them, in float32 (a thousandth of a pixel)."""
    depth = view.depth[first:last]
    x, y = (part[first:last] for part in view.rays)
    moved = [((a * x + b * y + c) * depth).add_(d) for a, b, c, d in view.color_from_depth[:3].tolist()]
    visible = (depth > 0) & (moved[2] > 0)
    z = torch.where(visible, moved[2], 1.0)  # what is not visible is not looked at, but must not become NaN
    x, y = moved[0] / z, moved[1] / z
    if view.color_distortion is not None:
        lens = view.color_distortion[None]
        visible &= (x.double().square() + y.double().square()).sqrt() < fold_radius(lens)
        xy = torch.stack([torch.where(visible, x, 0.0), torch.where(visible, y, 0.0)], dim=-1)
        x, y = distort_normalized(xy[None].double(), lens)[0].float().unbind(-1)
    (fx, skew, cx), (_, fy, cy), _ = view.color_intrinsics.tolist()
    return _Projection(fx * x + skew * y + cx, fy * y + cy, z, visible)


def _behind(seen: _Projection, registered: Tensor, max_jump: float) -> tuple[Tensor, Tensor, Tensor]:
    """Say which pixels lie outside the color image and which behind its surface, and the color pixel of each."""
    height, width = registered.shape
    u, v = (seen.u + 0.5).floor_(), (seen.v + 0.5).floor_()
    outside = ~(seen.visible & (u >= 0) & (u < width) & (v >= 0) & (v < height))
    target = v.clamp_(0, height - 1).long().mul_(width).add_(u.clamp_(0, width - 1).long())
    front = registered.flatten()[target]
    return outside, ~outside & (front > 0) & (seen.depth > (1 + max_jump) * front), target
