"""Which points lie in a box, in a prism over a polygon, or repeat another one; True = it does."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.numbers import checked_places, numbers_on_host
from pcdata.contracts.on_host import on_host, read_together, uploaded
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ConfigError, ShapeError
from pcdata.functional.equal_rows import numbered_rows
from pcdata.functional.rows import cloud_of_rows, group_first, rows_of_mask
from pcdata.threads import at_once

_PAIRS = 1 << 20  # points and edges looked at together


@op(points="N 3", ptr="ptr N B", lower=checked_places, upper=checked_places, gradient=False)
def box_mask(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    lower: Sequence[float] | Sequence[Sequence[float]] | Tensor,
    upper: Sequence[float] | Sequence[Sequence[float]] | Tensor,
    backend: str = "auto",
) -> Tensor:  # (N,) bool
    """Mark the points inside an axis-aligned box, its faces included: lower <= point <= upper, in float32.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        lower: smallest x, y, z, (3,) or one per cloud (B, 3).
        upper: largest x, y, z, likewise.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ConfigError: corners that are not finite, or a lower one that is not below the upper one.
    """
    assert ptr is not None  # @op fills it
    assert isinstance(lower, Tensor)  # and makes both (B, 3)
    assert isinstance(upper, Tensor)
    require_box(lower, upper)
    cloud = cloud_of_rows(ptr)
    return ((points >= lower.float()[cloud]) & (points <= upper.float()[cloud])).all(1)


def require_box(lower: Tensor, upper: Tensor) -> None:
    """Require corners (B, 3) of which the lower is below the upper on every axis."""
    for b in (on_host(lower) >= on_host(upper)).any(1).nonzero().squeeze(1).tolist():
        raise ConfigError(
            f"box_mask: lower must be below upper on every axis, cloud {b} has {lower[b].tolist()}, {upper[b].tolist()}"
        )


def checked_polygon(where: str, name: str, arguments: Mapping[str, Any]) -> Tensor:
    """Require at least three corners (P, 2), finite; bodies get (P, 2) float64."""
    corners = numbers_on_host(arguments[name])
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise ShapeError(f"{where}: {name} must be the corners (P, 2), three or more, got {tuple(corners.shape)}")
    if not bool(torch.isfinite(corners).all()):
        raise ConfigError(f"{where}: {name} must be finite, got {corners.tolist()}")
    return uploaded(corners, arguments["points"].device)


@op(points="N 2", polygon=checked_polygon, gradient=False)
def polygon_mask(
    points: Tensor,  # (N, 2) float32
    *,
    polygon: Sequence[Sequence[float]] | Tensor,
    backend: str = "auto",
) -> Tensor:  # (N,) bool
    """Mark the points of a plane that lie in a polygon, which may be concave.

    Those are the points from which a ray crosses an odd number of edges, in float64. Of points exactly on an edge,
    those on the left and lower ones count as inside, the others not, so polygons that share an edge share no point.

    Args:
        points: two coordinates each: points[:, :2] looks down along z.
        polygon: its corners in order (P, 2), either way round; the last is joined to the first.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ShapeError: fewer than three corners, or not (P, 2).
        ConfigError: a corner that is not finite.

    Source: Shimrat, Algorithm 112: Position of point relative to polygon, Communications of the ACM 5(8), 1962.
    """
    assert isinstance(polygon, Tensor)  # @op makes it one
    inside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    (ax, ay), (bx, by) = polygon.unbind(1), polygon.roll(-1, 0).unbind(1)
    slope = (bx - ax) / torch.where(by == ay, 1.0, by - ay)
    for rows in torch.arange(len(points), dtype=torch.int64, device=points.device).split(
        max(1, at_once(points.device, _PAIRS) // len(ax))
    ):
        x, y = points[rows].double().unbind(1)
        spans = (ay <= y[:, None]) != (by <= y[:, None])  # a level edge never does
        inside[rows] = (spans & (x[:, None] < ax + (y[:, None] - ay) * slope)).sum(1) % 2 == 1
    return inside


@op(points="N 3", ptr="ptr N B", gradient=False)
def duplicate_mask(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    backend: str = "auto",
) -> Tensor:  # (N,) bool
    """Mark the points that repeat an earlier one of their cloud, coordinate for coordinate (0 and -0 are equal).

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.
    """
    assert ptr is not None  # @op fills it
    group, number = numbered_rows(points, ptr)
    rows = torch.arange(len(points), dtype=torch.int64, device=points.device)
    return group_first(group, number)[group] != rows


def convex_hull(
    points: Tensor,  # (N, 2) float
) -> Tensor:  # (P,) int64 rows
    """Return the corners of the convex hull of points in a plane, counterclockwise; points on its edges are none.

    Fewer than three rows come back where all points lie on a line.

    Raises:
        ShapeError, DTypeError, NonFiniteError: the points are not (N, 2) finite numbers.

    Source: Barber, Dobkin and Huhdanpaa, The quickhull algorithm for convex hulls, ACM TOMS 22(4), 1996; in a plane.
    """
    check_tensors("convex_hull", {"points": points}, {"points": "N 2 : float"})
    return hull_rows(points.detach().double())


@inner
def hull_rows(points: Tensor, *, backend: str = "auto") -> Tensor:  # (P,) int64
    """Return the rows that :func:`convex_hull` gives, of points (N, 2) float64."""
    row = torch.arange(len(points), dtype=torch.int64, device=points.device)
    if not len(row):
        return row
    x, y = points.unbind(1)
    first = torch.where(x == x.min(), y, torch.inf).argmin()
    last = torch.where(x == x.max(), y, -torch.inf).argmax()
    # Edges of the hull so far, in order, and the points to the right of each: the farthest of those is a corner too.
    begin, end = torch.stack([first, last]), torch.stack([last, first])
    edge = torch.zeros_like(row)
    row, edge = torch.cat([row, row]), torch.cat([edge, edge + 1])
    is_one = (points[first] == points[last]).all()
    while True:
        side = points[end] - points[begin]
        offset, across = points[row] - points[begin[edge]], side[edge]
        beyond = offset[:, 0] * across[:, 1] - offset[:, 1] * across[:, 0]
        outside = beyond > (1e-12 * side.square().sum(1))[edge]
        splits = torch.zeros_like(begin).scatter_reduce_(0, edge, outside.long(), "amax")
        (one,), (count,), (new,) = read_together([is_one, outside.sum(), splits.sum()])
        if one:
            return begin[:1]
        if not count:
            return begin
        kept = rows_of_mask(outside, count)
        row, edge, beyond = row[kept], edge[kept], beyond[kept]
        farthest = beyond.new_full((len(begin),), -torch.inf).scatter_reduce_(0, edge, beyond, "amax")
        place = torch.arange(count, dtype=torch.int64, device=row.device)
        place = torch.where(beyond == farthest[edge], place, count)
        corner = torch.full_like(begin, count).scatter_reduce_(0, edge, place, "amin").clamp(max=count - 1)
        # An edge that is split becomes two, one after the other, and both look at its points.
        number = torch.arange(len(begin), dtype=torch.int64, device=row.device) + splits.cumsum(0) - splits
        begins, ends = (torch.empty(len(begin) + new, dtype=torch.int64, device=row.device) for _ in range(2))
        begins[number], ends[number] = begin, torch.where(splits > 0, row[corner], end)
        begins[number + splits], ends[number + splits] = torch.where(splits > 0, row[corner], begin), end
        first_piece = number[edge]
        row, edge = torch.cat([row, row]), torch.cat([first_piece, first_piece + 1])
        begin, end = begins, ends


def plane_axes(plane: Tensor) -> Tensor:
    """Return two orthogonal directions (3, 2) float64 in a plane (4,): the first across its normal's least component.

    With the normal as third they are right-handed, so counterclockwise is seen from the side that it points to.
    """
    x, y, z = plane[:3].tolist()  # in separate operations: every backend gives the same bits
    sizes = [abs(x), abs(y), abs(z)]
    across = ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))[sizes.index(min(sizes))]
    length = math.sqrt((across[0] * across[0] + across[1] * across[1]) + across[2] * across[2])
    u, v, w = (along / length for along in across)
    axes = [[u, y * w - z * v], [v, z * u - x * w], [w, x * v - y * u]]
    return uploaded(torch.tensor(axes, dtype=torch.float64, device="cpu"), plane.device)


def over_hull(
    points: Tensor,  # (n, 3)
    base: Tensor,  # (m, 3)
    plane: Tensor,  # (4,)
    margin: float,
) -> Tensor:  # (n,) bool
    """Mark points over or under the convex hull of base in a plane, or within ``margin`` of the lines of its edges."""
    axes = plane_axes(plane.detach())
    flat, flat_base = points.detach().double() @ axes, base.detach().double() @ axes
    corners = flat_base[hull_rows(flat_base)]
    if len(corners) < 3:
        return torch.zeros(len(points), dtype=torch.bool, device=points.device)
    edge = corners.roll(-1, 0) - corners
    outward = torch.stack([edge[:, 1], -edge[:, 0]], dim=1) / edge.norm(dim=1, keepdim=True)
    beyond = torch.full_like(flat[:, 0], -torch.inf)
    for corner, direction in zip(corners, outward):  # tens of them
        beyond = torch.maximum(beyond, (flat - corner) @ direction)
    return beyond <= margin
