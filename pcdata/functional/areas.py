"""How much surface was seen of objects: a size that means the same at every resolution and distance."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pcdata.functional.equal_rows import numbered_rows
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.neighborhoods import neighborhood_covariance
from pcdata.functional.rows import ptr_from_counts, transform_points

_REACH = 0.008  # metres to all sides that slope and spacing are taken over: more than the noise, less than an object
_PIXELS = (1, 12)  # the same in the image, at least and at most
_STEEPEST = 5.0  # times the length that a pixel covers facing the camera: beyond 78 degrees it is a jump, not a slope
_AROUND = (12, 32, 96)  # points whose spread tells the spacing: of few points, of more, and where they lie densely
_ASKED = 2000  # points of an object, about, that are looked at: the others are like them


def seen_areas(
    points: Tensor,  # (N, 3) float32 metres, of one cloud
    group: Tensor,  # (N,) int64, -1 = none
    num_groups: int,
    grid: ImageGrid | None,
) -> Tensor:  # (K,) float64 square metres
    """Return the area that was seen of each group of points.

    On a depth image a point stands for what its pixel covers of a surface that leans as the points of its group some
    pixels aside say, where no jump lies between. Elsewhere, as after views were merged, it is the spread of the nearest
    points that tells how densely they lie; equal points count once, and what has few points, some dozens on several
    faces, comes out up to a third too small. Noise that is no more than a Kinect's at 1 m (3 mm)
    changes areas by a few parts in a hundred, twice as much by a tenth or two.
    """
    rows = (group >= 0).nonzero().squeeze(1)
    points, group = points.detach()[rows], group[rows]
    if grid is None:
        areas = [_of_spacing(points[group == number]) for number in range(num_groups)]
        return torch.tensor(areas, dtype=torch.float64, device=points.device)
    if grid.camera_from_points is not None:
        points = transform_points(points, ptr_from_counts([len(rows)], device=rows.device), grid.camera_from_points)
    count = torch.bincount(group, minlength=num_groups)
    step = torch.div(count, _ASKED, rounding_mode="floor").clamp(min=1)
    every = torch.arange(len(rows), dtype=torch.int64, device=rows.device)
    asked = (every % step[group] == 0).nonzero().squeeze(1)
    covered = _of_pixels(points.double(), group, grid, grid.pixel_index[rows], asked)
    own = group[asked]
    share = count / torch.bincount(own, minlength=num_groups).clamp(min=1)
    return torch.bincount(own, weights=covered, minlength=num_groups) * share


def _of_pixels(points: Tensor, group: Tensor, grid: ImageGrid, pixel: Tensor, asked: Tensor) -> Tensor:
    """Return the area (A,) of the points asked for, among points (n, 3) in their camera's frame on some pixels."""
    height, width = grid.size
    margin = _PIXELS[1]
    row_of = torch.full((height + 2 * margin, width + 2 * margin), -1, dtype=torch.int64, device=points.device)
    v, u = pixel // width + margin, pixel % width + margin
    row_of[v, u] = torch.arange(len(points), dtype=torch.int64, device=points.device)
    v, u, own = v[asked], u[asked], group[asked]
    z = points[asked, 2].abs()
    sides = []
    for axis, (down, right) in enumerate(((0, 1), (1, 0))):
        covered = z / grid.intrinsics[0, axis, axis].double()  # of a surface that faces the camera
        facing = torch.zeros_like(points[asked])
        facing[:, axis] = covered
        steps = (_REACH / covered.clamp(min=1e-12)).round().clamp(*_PIXELS).to(torch.int64)
        ends: list[Tensor] = []
        for way in (1, -1):
            other = row_of[v + way * down * steps, u + way * right * steps]
            ends.append(torch.where((other >= 0) & (group[other] == own), other, -1))
        sides.append(_slope(points, asked, ends[0], ends[1], steps, facing, _STEEPEST * covered))
    return torch.linalg.cross(*sides).norm(dim=1)


def _slope(
    points: Tensor, asked: Tensor, after: Tensor, before: Tensor, steps: Tensor, facing: Tensor, longest: Tensor
) -> Tensor:  # (A, 3)
    """Return how the surface goes on from pixel to pixel: over both sides, else over one, else facing the camera."""
    found = facing
    chosen = torch.zeros_like(after, dtype=torch.bool)
    for start, stop, count in ((before, after, 2 * steps), (asked, after, steps), (before, asked, steps)):
        there = (start >= 0) & (stop >= 0) & ~chosen
        along = (points[stop] - points[start]) / count[:, None]
        there &= along.norm(dim=1) <= longest
        found = torch.where(there[:, None], along, found)
        chosen |= there
    return found


def _of_spacing(points: Tensor) -> float:
    """Return the area of one object from the spread of the points around each.

    A disc of evenly spread points has the variance r^2 / 4 along both its axes, so its area is 4 pi times the root of
    their product. That holds nearly where the disc is cut by an edge, and noise across the surface does not count.
    """
    whole = torch.tensor([0, len(points)], dtype=torch.int64, device=points.device)
    group, number = numbered_rows(points, whole)  # equal points
    first = torch.full((number,), len(points), dtype=torch.int64, device=points.device)
    first.scatter_reduce_(0, group, torch.arange(len(points), dtype=torch.int64, device=points.device), "amin")
    distinct = points[first]
    asked = distinct[:: max(1, number // _ASKED)]
    few, some, many = _AROUND
    around = min(max(number // 8, few), some)
    area = _of_spread(distinct, asked, min(around, number))
    # Where points lie more densely than the noise across the surface, the nearest are no disc.
    within = math.pi * _REACH**2 * number / area if area > 0 else 0.0
    if within > 1.5 * around:
        area = _of_spread(distinct, asked, min(int(within), many, number))
    return area


def _of_spread(points: Tensor, asked: Tensor, around: int) -> float:
    if not len(points):
        return 0.0
    _, covariance, _ = neighborhood_covariance(points, queries=asked, max_neighbors=around)
    variance = torch.linalg.eigvalsh(covariance).clamp(min=0)
    return float((variance[:, 1] * variance[:, 2]).sqrt().mean()) * 4 * math.pi / around * len(points)
