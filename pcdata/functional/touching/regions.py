"""Smooth regions of a depth image: faces of objects, bounded by creases and jumps.

Source: Meyer, Topographic distance and watershed lines, Signal Processing 38, 1994 (flooding from markers); Richtsfeld
et al., Segmentation of unknown objects in indoor environments, IROS 2012 (surfaces first, then objects).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.functional.touching.limits import (
    CREASE_PIXELS,
    KINECT_NOISE,
    LEVELS,
    NORMAL_PIXELS,
    SMOOTH,
    Limits,
)


class PixelCamera(NamedTuple):
    """Focal lengths and principal point in pixels of the image at hand."""

    fx: float
    fy: float
    cx: float
    cy: float


class Regions(NamedTuple):
    """The regions of an image; all without a region where there is no reading."""

    label: Tensor  # (H, W) int64, in the order of the first pixels of their seeds, -1 = none
    normals: Tensor  # (H, W, 3) float64 unit normals toward the camera; 0 where none could be fitted


def spread(noise: float) -> float:
    """Return how much lengths grow with the noise of 1/z, see :mod:`pcdata.functional.touching.limits`."""
    return math.sqrt(noise / KINECT_NOISE)


@inner
def smooth_regions(
    inverse: Tensor,  # (H, W) float64, 1/z in 1/m, 0 = no reading
    camera: PixelCamera,
    noise: float,
    limits: Limits,
    *,
    backend: str = "auto",
) -> Regions:
    """Cut the readings of an image into regions that are smooth inside.

    Planes are linear in 1/z over the image, and the noise of sensors that triangulate is the same everywhere in it, so
    all is fitted and compared there. Regions start where no crease is near and flood the rest, over jumps last: through
    ever sharper creases, one pixel at a time, the lowest of the regions that reach a pixel first.
    """
    there = inverse > 0
    scale = spread(noise)
    rows, columns = _rays(inverse.shape, camera, inverse.device)
    reach = in_pixels(limits.normal_reach * scale, camera, inverse, NORMAL_PIXELS)
    normals = _window_normals(inverse, there, reach, camera, noise, limits, rows, columns)
    crease = _creases(inverse, there, normals, camera, noise, limits, rows, columns, scale)
    across, along = _jumps(inverse, there, limits.jump * noise)
    seeds = _seeds(inverse, there, crease, across, along, camera, limits)
    return Regions(_flooded(seeds, crease, there, across, along), normals)


def _rays(shape: torch.Size, camera: PixelCamera, device: torch.device) -> tuple[Tensor, Tensor]:
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


def plane_normal(right: Tensor, down: Tensor, middle: Tensor, x: Tensor, y: Tensor, camera: PixelCamera) -> Tensor:
    """Return (..., 3) unit normals toward the camera of planes of 1/z = middle on the ray (x, y, 1)."""
    along_x, along_y = right * camera.fx, down * camera.fy
    along_z = (middle - along_x * x) - along_y * y
    length = ((along_x * along_x + along_y * along_y) + along_z * along_z).sqrt()
    safe = torch.where(length > 0, length, 1.0)
    return torch.stack([-along_x / safe, -along_y / safe, -along_z / safe], dim=-1)


def _window_normals(
    inverse: Tensor,
    there: Tensor,
    reach: Tensor,
    camera: PixelCamera,
    noise: float,
    limits: Limits,
    rows: Tensor,
    columns: Tensor,
) -> Tensor:
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
    normals = plane_normal(right_slope, down_slope, inverse + middle, columns, rows, camera)
    return torch.where((found & there)[..., None], normals, 0.0)


def _creases(
    inverse: Tensor,
    there: Tensor,
    normals: Tensor,
    camera: PixelCamera,
    noise: float,
    limits: Limits,
    rows: Tensor,
    columns: Tensor,
    scale: float,
) -> Tensor:
    """Return how sharp the crease at every pixel is, 0 to 1: the sharpest of four directions, smoothed."""
    depth = torch.where(there, 1 / torch.where(there, inverse, 1.0), 0.0)
    points = torch.stack([columns * depth, rows * depth, depth], dim=-1)
    reach = in_pixels(limits.crease_reach * scale, camera, inverse, CREASE_PIXELS)
    fitted = (normals != 0).any(-1)
    sharpest = torch.zeros_like(inverse)
    for right, down in ((1, 0), (0, 1), (1, 1), (1, -1)):
        # Diagonal steps are longer.
        steps = reach if right * down == 0 else (reach * math.sqrt(0.5) + 0.5).floor().clamp(min=1)
        for count in steps[there].unique().to(torch.int64).tolist():
            usable = there & (steps == count)
            for one in (-count, count):
                usable &= shifted(fitted, one * down, one * right)
            last = shifted(inverse, -count * down, -count * right)
            for step in range(1 - count, count + 1):
                now = shifted(inverse, step * down, step * right)
                usable &= (now > 0) & ((now - last).abs() < limits.step * noise)
                last = now
            before, behind = (shifted(normals, one * down, one * right) for one in (-count, count))
            way = shifted(points, count * down, count * right) - shifted(points, -count * down, -count * right)
            apart = length(behind - before)
            # Normals that lean toward each other stand in a valley.
            part = torch.where(dot(behind - before, way) < 0, apart, limits.convex_part * apart)
            sharpest = torch.maximum(sharpest, torch.where(usable, part, 0.0))
    return _smoothed((sharpest / limits.full_crease).clamp(max=1), there)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Multiply vectors (..., 3), in the order in which kernels add."""
    x, y, z = (a * b).unbind(-1)
    return (x + y) + z


def length(vectors: Tensor) -> Tensor:
    """Return the lengths of vectors (..., 3)."""
    return dot(vectors, vectors).sqrt()


# A Gaussian of one pixel.
_KERNEL = (0.054488, 0.244202, 0.402619, 0.244202, 0.054488)


def _smoothed(image: Tensor, there: Tensor) -> Tensor:
    """Average with a Gaussian over the pixels that are there."""
    total, weight = torch.where(there, image, 0.0), there.to(image.dtype)
    for down, right in ((1, 0), (0, 1)):
        total, weight = (_convolved(one, down, right) for one in (total, weight))
    return torch.where(there, total / torch.where(there, weight, 1.0), 1.0)


def _convolved(image: Tensor, down: int, right: int) -> Tensor:
    result = torch.zeros_like(image)
    for offset, factor in enumerate(_KERNEL, -2):
        result += factor * shifted(image, offset * down, offset * right)
    return result


def _jumps(inverse: Tensor, there: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """Mark the pairs of neighbors in rows (H, W-1) and columns (H-1, W) with a jump between them.

    Neither the step itself nor its difference from the step before or behind it may be small.
    """
    return _row_jumps(inverse, there, limit), _row_jumps(inverse.T, there.T, limit).T


def _row_jumps(inverse: Tensor, there: Tensor, limit: float) -> Tensor:
    both = there[:, 1:] & there[:, :-1]
    step = inverse[:, 1:] - inverse[:, :-1]
    bend = (step[:, 1:] - step[:, :-1]).abs() > limit
    jump = both & (step.abs() > limit)
    jump[:, 1:] &= bend | ~both[:, :-1]
    jump[:, :-1] &= bend | ~both[:, 1:]
    return jump


def _seeds(
    inverse: Tensor,
    there: Tensor,
    crease: Tensor,
    across: Tensor,
    along: Tensor,
    camera: PixelCamera,
    limits: Limits,
) -> Tensor:
    """Number the parts that are smooth together with all pixels around them, and large enough.

    First the smoothest, then what is as smooth as the next limit and holds none of them; each in the order of first
    pixels.
    """
    open_ = there.clone()
    open_[:, 1:] &= ~across
    open_[:, :-1] &= ~across
    open_[1:] &= ~along
    open_[:-1] &= ~along
    area = torch.where(there, 1 / (inverse * inverse).clamp(min=1e-12), 0.0) / (camera.fx * camera.fy)
    seeds = torch.full_like(crease, -1, dtype=torch.int64)
    number = 0
    for factor in SMOOTH:
        if factor > limits.roughest:
            break
        smooth = open_ & (crease < limits.smooth * factor)
        inside = smooth.clone()
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                inside &= shifted(smooth, down, right)
        part = connected_pixels(inside, across, along)
        size = torch.zeros(inside.numel() + 1, dtype=torch.float64, device=inverse.device)
        size.index_add_(0, part.flatten(), area.flatten())
        size[part[inside & (seeds >= 0)]] = 0  # holds a smoother one
        large = size >= limits.seed_area
        large[-1] = False
        own = torch.where(large, large.cumsum(0) - 1 + number, -1)[part]
        seeds = torch.where(own >= 0, own, seeds)
        number += int(large.sum())
    return seeds


def parted_at_jumps(
    inverse: Tensor,  # (H, W) float64
    label: Tensor,  # (H, W) int64, -1 = none
    camera: PixelCamera,
    noise: float,
    limits: Limits,
) -> Tensor:  # (H, W) int64
    """Make regions of their own of what jumps part in one; parts smaller than seeds are of none."""
    across, along = _jumps(inverse, inverse > 0, limits.jump * noise)
    across, along = across | (label[:, 1:] != label[:, :-1]), along | (label[1:] != label[:-1])
    part = connected_pixels(label >= 0, across, along)
    area = torch.where(inverse > 0, 1 / (inverse * inverse).clamp(min=1e-12), 0.0) / (camera.fx * camera.fy)
    size = torch.zeros(label.numel() + 1, dtype=torch.float64, device=label.device)
    size.index_add_(0, part.flatten(), area.flatten())
    large = size >= limits.seed_area
    large[-1] = False
    return torch.where(large, large.cumsum(0) - 1, -1)[part]


def connected_pixels(mask: Tensor, across: Tensor, along: Tensor) -> Tensor:
    """Return for every pixel of the mask the lowest pixel it is connected to, over neighbors without a jump.

    H * W stands where the mask is not.
    """
    height, width = mask.shape
    none = height * width
    pixel = torch.arange(none, dtype=torch.int64, device=mask.device).reshape(height, width)
    pairs = []
    for linked, first, second in (
        (mask[:, 1:] & mask[:, :-1] & ~across, pixel[:, :-1], pixel[:, 1:]),
        (mask[1:] & mask[:-1] & ~along, pixel[:-1], pixel[1:]),
    ):
        pairs.append(torch.stack([first[linked], second[linked]]))
    link = torch.cat(pairs, 1)
    lowest = torch.arange(none + 1, dtype=torch.int64, device=mask.device)
    while True:
        a, b = lowest[link[0]], lowest[link[1]]
        if bool((a == b).all()):
            break
        lowest.scatter_reduce_(0, torch.maximum(a, b), torch.minimum(a, b), "amin")
        while not bool((lowest[lowest] == lowest).all()):
            lowest = lowest[lowest]
    return torch.where(mask, lowest[:-1].reshape(height, width), none)


def _flooded(seeds: Tensor, crease: Tensor, there: Tensor, across: Tensor, along: Tensor) -> Tensor:
    """Let the seeds (-1 = none) take all pixels they reach: see :func:`smooth_regions`."""
    none = torch.iinfo(torch.int64).max
    level = (crease * LEVELS).floor().to(torch.int64)
    label = torch.where(seeds < 0, none, seeds)
    for closed_across, closed_along in ((across, along), (torch.zeros_like(across), torch.zeros_like(along))):
        for now in range(LEVELS + 1):
            dry = there & (level <= now)
            while True:
                reached = torch.full_like(label, none)
                left, right = label[:, :-1], label[:, 1:]
                reached[:, 1:] = torch.minimum(reached[:, 1:], torch.where(closed_across, none, left))
                reached[:, :-1] = torch.minimum(reached[:, :-1], torch.where(closed_across, none, right))
                reached[1:] = torch.minimum(reached[1:], torch.where(closed_along, none, label[:-1]))
                reached[:-1] = torch.minimum(reached[:-1], torch.where(closed_along, none, label[1:]))
                taken = dry & (label == none) & (reached < none)
                if not bool(taken.any()):
                    break
                label = torch.where(taken, reached, label)
    return torch.where(label == none, -1, label)
