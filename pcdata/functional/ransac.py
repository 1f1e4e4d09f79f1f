"""The shape of each cloud that most of its points lie on: random hypotheses, then least squares of its own inliers.

Source: Fischler & Bolles, CACM 24(6), 1981; the refinement is Gauss and Newton's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.on_host import counts_of
from pcdata.errors import NoShapeError
from pcdata.functional.row_draws import draw_rows
from pcdata.functional.rows import cloud_of_rows, count_per_cloud, counts_from_ptr, ptr_from_counts
from pcdata.geometry.rigid import angle_between
from pcdata.geometry.shape_fit import Family, length
from pcdata.rng import seeded
from pcdata.threads import at_once

# Points of a cloud that its hypotheses are compared on at first, and how many of those then meet all of its points.
SCORED, FINALISTS = 4096, 16
_MAX_REFINEMENTS = 20  # as of planes
_STEPS = 3  # of Newton between two looks at who the inliers are
_PAIRS = 1 << 15  # of points and hypotheses looked at together: 256 KB
_MOST_HYPOTHESES = 1 << 18  # drawn at a time, over all clouds


class Limits(NamedTuple):
    """What a shape must be to compete."""

    radius: tuple[float, float] | None  # least and largest
    axis: Tensor | None  # (B, 3) float64 unit vectors on the CPU
    max_tilt: float | None  # radians from the axis or its opposite

    def of(self, clouds: slice | Tensor) -> Limits:
        """Return those of some clouds."""
        return self._replace(axis=None if self.axis is None else self.axis[clouds])

    def allow(self, family: Family, shapes: Tensor) -> Tensor:
        """Say which shapes (B, ..., K) compete."""
        allowed = ~shapes[..., 0].isnan()
        if family.has_radius:
            radius = shapes[..., -1]
            low, high = (0.0, math.inf) if self.radius is None else self.radius
            allowed &= (radius > 0) & (radius >= low) & (radius <= high)
        if self.axis is not None and self.max_tilt is not None:
            axis = self.axis.to(shapes.device).reshape(len(shapes), *[1] * (shapes.ndim - 2), 3)
            angle = angle_between(shapes[..., 3:6], axis)
            allowed &= torch.minimum(angle, math.pi - angle) <= self.max_tilt
        return allowed


def found_shapes(
    where: str,
    family: Family,
    points: Tensor,  # (N, 3)
    ptr: Tensor,  # (B+1,)
    normals: Tensor | None,  # (N, 3)
    distance: float,
    num_hypotheses: int,
    seeds: list[int],
    limits: Limits,
) -> tuple[Tensor, Tensor]:  # shapes (B, K) float64, inliers (N,) bool
    """Find the shape of each cloud with the most points nearer than ``distance``.

    Raises:
        NoShapeError: a cloud has none within the limits, or none that enough points are near.
    """
    cloud = cloud_of_rows(ptr)
    # About a point of each cloud, however far it lies from the origin.
    origin = points[ptr[:-1]].double()
    near = points.double() - origin[cloud]
    if normals is not None:
        wide = normals.double()
        normals = wide / length(wide)[:, None]  # zero vectors become NaN, which are near nothing
    at_once = max(1, _MOST_HYPOTHESES // num_hypotheses)
    best = []
    for first in range(0, len(ptr) - 1, at_once):
        own = slice(first, min(first + at_once, len(ptr) - 1))
        best.append(_winners(where, family, near, ptr, normals, distance, num_hypotheses, seeds, limits, own))
    shapes, inliers = _refined(family, near, ptr, cloud, torch.cat(best), distance, limits)
    return torch.cat([shapes[:, :3] + origin, shapes[:, 3:]], 1), inliers


def _winners(
    where: str,
    family: Family,
    points: Tensor,
    ptr: Tensor,
    normals: Tensor | None,
    distance: float,
    num_hypotheses: int,
    seeds: list[int],
    limits: Limits,
    own: slice,
) -> Tensor:
    """Return the hypothesis of each of some clouds that most points are near, the earliest of equals, (b, K)."""
    sizes = counts_from_ptr(ptr)[own].tolist()
    starts = ptr[:-1][own]
    draws: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}
    for key in zip(sizes, seeds[own]):  # equal clouds share a draw
        if key not in draws:
            generator = seeded(key[1])
            rows = draw_rows(key[0], family.sample, num_hypotheses, generator)
            draws[key] = rows, torch.randperm(key[0], generator=generator, device="cpu")[:SCORED].sort().values
    keys = list(zip(sizes, seeds[own]))
    rows = torch.stack([draws[key][0] for key in keys]).to(points.device) + starts[:, None, None]
    shapes = family.through(points[rows], None if normals is None else normals[rows])
    allowed = limits.of(own).allow(family, shapes)
    for b in (~allowed.any(1)).nonzero().squeeze(1).tolist():
        some = bool((~shapes[b, :, 0].isnan()).any())
        reason = (
            f"none of the {num_hypotheses} hypotheses is one within the limits"
            if some
            else f"no {family.sample} of its points that were drawn determine one"
        )
        raise NoShapeError(f"{where}: cloud {own.start + b}: {reason}")
    scored = torch.cat([draws[key][1].to(points.device) + start for key, start in zip(keys, starts.tolist())])
    scored_ptr = ptr_from_counts([min(size, SCORED) for size in sizes], points.device)
    counts = count_near(family, points[scored], scored_ptr, shapes, distance).masked_fill(~allowed, -1)
    if max(sizes) > SCORED:
        order = torch.arange(num_hypotheses, dtype=torch.int64, device=points.device)
        ranked = (counts * num_hypotheses + (num_hypotheses - 1 - order)).topk(min(FINALISTS, num_hypotheses)).indices
        ranked = ranked.sort(1).values
        finalists = shapes.gather(1, ranked[..., None].expand(-1, -1, shapes.shape[-1]))
        whole = ptr[own.start : own.stop + 1]
        part = points[int(whole[0]) : int(whole[-1])]
        found = count_near(family, part, whole - whole[0], finalists, distance)
        counts, shapes = found.masked_fill(counts.gather(1, ranked) < 0, -1), finalists
    winner = counts.argmax(1)  # the first of equals, as torch documents
    for b in (counts.amax(1) < family.sample).nonzero().squeeze(1).tolist():
        raise NoShapeError(
            f"{where}: cloud {own.start + b}: no {family.name} has {family.sample} points nearer than "
            f"distance={distance:g}; is it in the right unit?"
        )
    return shapes[torch.arange(len(shapes), dtype=torch.int64, device=points.device), winner]


def count_near(family: Family, points: Tensor, ptr: Tensor, shapes: Tensor, distance: float) -> Tensor:  # (B, P) int64
    """Count the points of each cloud that are near its shapes (B, P, K); clouds of about one size go side by side."""
    counts = torch.zeros(shapes.shape[:2], dtype=torch.int64, device=points.device)
    sizes, pairs = counts_of(ptr), at_once(points.device, _PAIRS)
    for bits in sorted({size.bit_length() for size in sizes}):
        clouds = [b for b, size in enumerate(sizes) if size.bit_length() == bits]
        widest = max(sizes[b] for b in clouds)
        column = torch.arange(widest, dtype=torch.int64, device=points.device)
        few = min(shapes.shape[1], max(1, pairs // widest))
        for some in torch.tensor(clouds, dtype=torch.int64, device=points.device).split(
            max(1, pairs // (widest * few))
        ):
            place = ptr[some][:, None] + column
            own = points[place.clamp(max=len(points) - 1)]
            own[place >= ptr[some + 1][:, None]] = torch.nan  # near nothing
            for first in range(0, shapes.shape[1], few):
                part = shapes[some, first : first + few]
                near = family.distance(own[:, None], part[:, :, None]) < distance
                counts[some, first : first + few] = near.sum(-1)
    return counts


def _refined(
    family: Family, points: Tensor, ptr: Tensor, cloud: Tensor, shapes: Tensor, distance: float, limits: Limits
) -> tuple[Tensor, Tensor]:
    """Refit to the inliers until they no longer change; a refit that loses half of them is not taken."""
    inliers = family.distance(points, shapes[cloud]) < distance
    counts = count_per_cloud(inliers, ptr).to(points.device)
    open_ = torch.ones(len(shapes), dtype=torch.bool, device=points.device)
    for _ in range(_MAX_REFINEMENTS):
        rows = (inliers & open_[cloud]).nonzero().squeeze(1)
        refitted = shapes
        for _ in range(_STEPS):
            refitted = family.moved(refitted, _newton(family, points[rows], refitted, cloud[rows]))
        after = family.distance(points, refitted[cloud]) < distance
        found = count_per_cloud(after, ptr).to(points.device)
        taken = open_ & limits.allow(family, refitted) & (2 * found >= counts)
        changed = count_per_cloud(after != inliers, ptr).to(points.device) > 0
        shapes = torch.where(taken[:, None], refitted, shapes)
        inliers = torch.where(taken[cloud], after, inliers)
        counts, open_ = torch.where(taken, found, counts), taken & changed
        if not bool(open_.any()):
            break
    return shapes, inliers


def _newton(family: Family, points: Tensor, shapes: Tensor, cloud: Tensor) -> Tensor:
    """Return the step (B, D) to the least squares of points (M, 3); NaN or anything where they determine none."""

    def total(values: Tensor) -> Tensor:  # in the order of the rows, on every number of threads
        return values.new_zeros(len(shapes)).index_add_(0, cloud, values)

    normal: dict[tuple[int, int], Tensor] = {}
    right: dict[int, Tensor] = {}
    for residual, slopes in family.linear(points, shapes[cloud]):
        for row, slope in enumerate(slopes):
            right[row] = right.get(row, 0.0) - total(slope * residual)
            for column in range(row + 1):
                normal[row, column] = normal.get((row, column), 0.0) + total(slope * slopes[column])
    size = len(right)
    matrix = torch.stack([torch.stack([normal[max(i, j), min(i, j)] for j in range(size)], 1) for i in range(size)], 1)
    steps = torch.linalg.solve_ex(matrix, torch.stack([right[i] for i in range(size)], 1)[..., None]).result
    return steps[..., 0]
