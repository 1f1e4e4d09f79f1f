"""Depth registered to colour: what the colour camera would measure, from what the depth camera did."""

from __future__ import annotations

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
    nearest = _rasterize(seen, (left, right, top, bottom), color_size)

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
    z = moved[2]
    visible = (depth > 0) & (z > 0)
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
    corner = torch.where(linked, 0.25 * (columns[..., 1:] + columns[..., :-1]), torch.nan)
    corner = torch.nn.functional.pad(corner, (1, 1, 1, 1), value=torch.nan)
    around = [corner[:, :-1, :-1], corner[:, :-1, 1:], corner[:, 1:, :-1], corner[:, 1:, 1:]]
    at_edge = (around[0] + around[1] + around[2] + around[3]).isnan()
    half = torch.where(at_edge, half, torch.nan)
    low, high = center - half, center + half
    for one in around:  # fmin and fmax pass over NaN
        low, high = torch.fmin(low, one), torch.fmax(high, one)
    return low, high


def _rasterize(
    seen: _Projection, cells: tuple[Tensor, Tensor, Tensor, Tensor], size: tuple[int, int]
) -> Tensor:  # (V, Hc, Wc) int64
    """Return at every colour pixel the smallest key, depth above index, of the cells that hold its centre."""
    height, width = size
    views, pixels = len(seen.depth), seen.depth[0].numel() if len(seen.depth) else 0
    # Half-open cells: a centre on a shared side belongs to one of the two. Clamped to the image before they are integers.
    left, right = (cells[i].ceil().clamp(0, width).flatten() for i in (0, 1))
    top, bottom = (cells[i].ceil().clamp(0, height).flatten() for i in (2, 3))
    paints = (seen.visible.flatten() & (right > left) & (bottom > top)).nonzero().squeeze(1)
    first_u, first_v = left[paints].int(), top[paints].int()
    across, down = right[paints].int() - first_u, bottom[paints].int() - first_v
    view = paints.div(pixels, rounding_mode="floor") if pixels else paints
    first = (view * height + first_v) * width + first_u
    keys = (seen.depth.flatten()[paints].view(torch.int32).long() << _INDEX_BITS) | (paints - view * pixels)
    nearest = torch.full((views * height * width,), _EMPTY, device=keys.device)
    steps_down, steps_across = (int(steps.max()) if len(steps) else 0 for steps in (down, across))
    for row in range(steps_down):
        for column in range(steps_across):
            if row == column == 0:
                nearest.scatter_reduce_(0, first, keys, "amin")
                continue
            reached = ((down > row) & (across > column)).nonzero().squeeze(1)
            target = first[reached] + (row * width + column)
            nearest.scatter_reduce_(0, target, keys[reached], "amin")
    return nearest.reshape(views, height, width)


def _occlusions(seen: _Projection, readings: Tensor, registered: Tensor, max_jump: float) -> tuple[Tensor, Tensor]:
    """Return which readings are hidden, (V, H, W), and the colour pixels that hide one, (V, Hc, Wc)."""
    height, width = registered.shape[1:]
    u, v = (seen.u + 0.5).floor(), (seen.v + 0.5).floor()
    inside = seen.visible & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    view = torch.arange(len(u), device=u.device)[:, None, None]
    u, v = (torch.where(inside, place, 0).long() for place in (u, v))
    target = (view * height + v) * width + u
    front = registered.flatten()[target.flatten()].reshape(u.shape)
    behind = inside & (front > 0) & (seen.depth - front > max_jump * front)
    occluding = torch.zeros(registered.numel(), dtype=torch.bool, device=u.device)
    occluding[target[behind]] = True
    return readings & (~inside | behind), occluding.reshape(registered.shape)
