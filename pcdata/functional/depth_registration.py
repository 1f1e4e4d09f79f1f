"""Depth registered to colour: what the colour camera would measure, from what the depth camera did."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.dispatch import op
from pcdata.errors import CaptureError, ConfigError
from pcdata.functional import rigid
from pcdata.functional.depth import check_intrinsics, check_lengths, check_rays, pixel_rays
from pcdata.functional.lens import check_distortion, distort_normalized, fold_radius

_INDEX_BITS = 32  # of a key in the z-buffer; the depth's bits lie above them
_EMPTY = torch.iinfo(torch.int64).max


class RegisteredDepth(NamedTuple):
    """Depth in the colour image, and who hides whom."""

    depth: Tensor  # (V, Hc, Wc) float32 metres along the colour camera's z, 0 = no reading
    pixel_index: Tensor  # (V, Hc, Wc) int64: the pixel v * W + u of the depth image it comes from, -1 = none
    occluding: Tensor  # (V, Hc, Wc) bool: a farther reading was hidden here by this nearer surface
    hidden: Tensor  # (V, H, W) bool: a reading that the colour camera does not see; it must not take its colour there


class _Projection(NamedTuple):
    """Where the colour camera sees the depth pixels; each (V, H, W)."""

    u: Tensor
    v: Tensor
    depth: Tensor  # float32, metres along the colour camera's z
    visible: Tensor  # bool: has a reading, lies before the camera and within the lens model


@op(
    depth="V H W",
    intrinsics="V 3 3 : float",
    color_intrinsics="V 3 3 : float",
    color_from_depth="V 4 4 : float64",
    distortion="V D : float",
    color_distortion="V E : float",
)
def register_depth(
    depth: Tensor,  # (V, H, W) float32 metres, 0 = no reading
    intrinsics: Tensor,  # (V, 3, 3) of the depth camera
    color_intrinsics: Tensor,  # (V, 3, 3) of the colour camera, at color_size
    color_from_depth: Tensor,  # (V, 4, 4) float64 rigid
    *,
    color_size: tuple[int, int],  # (height, width)
    distortion: Tensor | None = None,  # (V, D) of the depth camera
    color_distortion: Tensor | None = None,  # (V, E) of the colour camera
    max_jump: float = 0.02,
    backend: str = "auto",
) -> RegisteredDepth:
    """Render the depth readings as the colour camera sees them, nearest first, without cracks.

    Every reading covers a cell of the colour image: the box around its four corners. Where the four pixels around a
    corner lie on one surface (depths within ``max_jump`` of the nearest), the corner is the mean of their projections,
    shared by all four: their cells leave no crack, whatever the sizes of the images. At an edge or a hole a pixel ends
    half a pixel from its centre. A colour pixel takes the nearest of the readings whose cells hold its centre (of
    equally near ones the first); nothing is interpolated.

    A reading is ``hidden`` if it projects outside the image, or onto a surface nearer by more than ``max_jump``.

    Raises:
        CaptureError: a negative depth, impossible intrinsics or distortion, or a reading where a lens has no inverse.
        PoseError: color_from_depth is not rigid.
        ConfigError: a size below one pixel or a jump that is not positive.

    Source: the z-buffer is as old as Catmull, 1974; librealsense's align draws the same boxes, but per pixel, so
    slanted surfaces crack.
    """
    where = "register_depth"
    if len(color_size) != 2 or min(color_size) < 1 or not max_jump > 0:
        raise ConfigError(
            f"{where}: color_size must be (height, width) of at least one pixel and max_jump more than 0, got "
            f"{color_size} and {max_jump}"
        )
    check_lengths(where, "depth", depth)
    for matrix, lens in ((intrinsics, distortion), (color_intrinsics, color_distortion)):
        check_intrinsics(where, matrix)
        if lens is not None:
            check_distortion(where, lens)
    rigid.check_rigid(f"{where}: color_from_depth", color_from_depth)
    if max(depth[0].numel() if len(depth) else 0, color_size[0] * color_size[1]) >= 1 << _INDEX_BITS:
        raise CaptureError(f"{where}: images of 2^32 pixels and more are not supported")

    rays = pixel_rays(intrinsics, (depth.shape[1], depth.shape[2]), distortion)
    check_rays(where, rays, depth > 0)
    seen = _project(depth, rays, color_intrinsics, color_from_depth, color_distortion)
    half_width, half_height = _half_pixel(depth, seen, intrinsics, color_intrinsics, color_from_depth)
    linked = _one_surface(depth, seen.visible, max_jump)
    left, right = _cell(seen.u, half_width, linked)
    top, bottom = _cell(seen.v, half_height, linked)
    views = zip(seen.depth, seen.visible, left, right, top, bottom)
    images = [_rasterize(one[0], one[1], one[2:], color_size) for one in views]
    nearest = torch.stack(images) if images else torch.empty((0, *color_size), dtype=torch.int64, device=depth.device)

    found = nearest != _EMPTY
    registered = torch.where(found, (nearest >> _INDEX_BITS).int().view(torch.float32), 0.0)
    pixel_index = torch.where(found, nearest & ((1 << _INDEX_BITS) - 1), -1)
    hidden, occluding = _occlusions(seen, depth > 0, registered, max_jump)
    return RegisteredDepth(registered, pixel_index, occluding, hidden)


def _project(
    depth: Tensor, rays: Tensor, intrinsics: Tensor, color_from_depth: Tensor, distortion: Tensor | None
) -> _Projection:
    """Move every reading into the colour camera and project it, in float32 (a thousandth of a pixel)."""
    rays = rays.float()
    motion = color_from_depth.float()[:, :, :, None, None]
    x, y = rays[..., 0], rays[..., 1]
    moved = [
        (motion[:, axis, 0] * x + motion[:, axis, 1] * y + motion[:, axis, 2]) * depth + motion[:, axis, 3]
        for axis in range(3)
    ]
    visible = (depth > 0) & (moved[2] > 0)
    z = torch.where(visible, moved[2], 1.0)  # what is not visible is not looked at, but must not become NaN
    x, y = moved[0] / z, moved[1] / z
    if distortion is not None:
        radius = (x.double().square() + y.double().square()).sqrt()
        visible &= radius < fold_radius(distortion)[:, None, None]
        xy = torch.stack([torch.where(visible, x, 0.0), torch.where(visible, y, 0.0)], dim=-1)
        x, y = distort_normalized(xy.double(), distortion).float().unbind(-1)
    k = intrinsics.float()[:, :, :, None, None]
    u = k[:, 0, 0] * x + k[:, 0, 1] * y + k[:, 0, 2]
    v = k[:, 1, 1] * y + k[:, 1, 2]
    return _Projection(u, v, z, visible)


def _half_pixel(
    depth: Tensor, seen: _Projection, intrinsics: Tensor, color_intrinsics: Tensor, color_from_depth: Tensor
) -> tuple[Tensor, Tensor]:
    """Return half the width and height, in colour pixels, of the box around a depth pixel that faces its camera."""
    turn = color_from_depth[:, :2, :2].abs() / torch.stack([intrinsics[:, 0, 0], intrinsics[:, 1, 1]], -1)[:, None]
    focal = torch.stack([color_intrinsics[:, 0, 0], color_intrinsics[:, 1, 1]], -1)
    extent = (0.5 * focal * turn.sum(-1)).float()[:, :, None, None]
    nearness = depth / seen.depth
    return extent[:, 0] * nearness, extent[:, 1] * nearness


def _one_surface(depth: Tensor, visible: Tensor, max_jump: float) -> Tensor:
    """Say for the (V, H - 1, W - 1) inner corners whether the four pixels around lie on one surface."""
    near = torch.where(visible, depth, 0.0)
    lows, highs = (combine(near[:, 1:], near[:, :-1]) for combine in (torch.minimum, torch.maximum))
    low = torch.minimum(lows[..., 1:], lows[..., :-1])
    high = torch.maximum(highs[..., 1:], highs[..., :-1])
    return (low > 0) & (high - low <= max_jump * low)


def _cell(center: Tensor, half: Tensor, linked: Tensor) -> tuple[Tensor, Tensor]:
    """Return one coordinate's lower and upper end of every pixel's cell."""
    columns = center[:, 1:] + center[:, :-1]
    corner = 0.25 * (columns[..., 1:] + columns[..., :-1])
    low = _around_pixels(torch.where(linked, corner, torch.inf), torch.inf, torch.minimum)
    high = _around_pixels(torch.where(linked, corner, -torch.inf), -torch.inf, torch.maximum)
    half = torch.where(_around_pixels(linked, False, torch.logical_and), -torch.inf, half)  # reaches nowhere
    return torch.minimum(low, center - half), torch.maximum(high, center + half)


def _around_pixels(inner_corners: Tensor, border: float, combine: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Combine the values of every pixel's four corners: (V, H - 1, W - 1) to (V, H, W)."""
    corners = torch.nn.functional.pad(inner_corners, (1, 1, 1, 1), value=border)
    rows = combine(corners[:, 1:], corners[:, :-1])
    return combine(rows[..., 1:], rows[..., :-1])


def _rasterize(
    depth: Tensor, visible: Tensor, cells: tuple[Tensor, Tensor, Tensor, Tensor], size: tuple[int, int]
) -> Tensor:  # (Hc, Wc) int64
    """Return at every colour pixel of one view the smallest key (depth, then index) of the cells over its centre."""
    height, width = size
    # Half-open cells: a centre on a shared side belongs to one of the two.
    left, right = (end.ceil().clamp(0, width).flatten() for end in cells[:2])
    top, bottom = (end.ceil().clamp(0, height).flatten() for end in cells[2:])
    pixels = (visible.flatten() & (right > left) & (bottom > top)).nonzero().squeeze(1)
    first_u, first_v = left[pixels].long(), top[pixels].long()
    across, down = right[pixels].long() - first_u, bottom[pixels].long() - first_v
    first = first_v * width + first_u
    keys = (depth.flatten()[pixels].view(torch.int32).long() << _INDEX_BITS) | pixels
    nearest = torch.full((height * width,), _EMPTY, device=keys.device)
    steps_down, steps_across = (int(steps.max()) if len(steps) else 0 for steps in (down, across))
    for row in range(steps_down):
        for column in range(steps_across):
            if row == column == 0:
                nearest.scatter_reduce_(0, first, keys, "amin")
                continue
            reached = ((down > row) & (across > column)).nonzero().squeeze(1)
            target = first[reached] + (row * width + column)
            nearest.scatter_reduce_(0, target, keys[reached], "amin")
    return nearest.reshape(size)


def _occlusions(seen: _Projection, readings: Tensor, registered: Tensor, max_jump: float) -> tuple[Tensor, Tensor]:
    """Return which readings are hidden, (V, H, W), and the colour pixels that hide one, (V, Hc, Wc)."""
    height, width = registered.shape[1:]
    u, v = (seen.u + 0.5).floor_(), (seen.v + 0.5).floor_()
    inside = seen.visible & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    target = v.clamp_(0, height - 1).long().mul_(width).add_(u.clamp_(0, width - 1).long())
    front = registered.flatten(1).gather(1, target.flatten(1)).reshape(u.shape)
    behind = inside & (front > 0) & (seen.depth > (1 + max_jump) * front)
    occluding = torch.zeros_like(registered, dtype=torch.bool)
    view, row, column = behind.nonzero().unbind(1)
    occluding.flatten(1)[view, target[view, row, column]] = True
    return readings & (~inside | behind), occluding
