"""The part of a plane that is a surface: a plane has no end, and crosses the walls around a table."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from pcdata.contracts.dispatch import REFERENCE, inner
from pcdata.contracts.on_host import bounds_of
from pcdata.functional.image_clusters import lowest_rows
from pcdata.functional.selection import hull_rows, plane_axes

MOST_CORNERS = 24  # of a hull: it is written with every sample
_MOST_POINTS = 1 << 14  # that tell where the surface is
_REACH = 5  # distances from the plane that tell whether something crosses it
_MOST_CELLS = 500  # along a side: a stray far away needs no more
_CELL = 4  # distances: the least edge of a cell
_MOST_LONELY = 0.2  # of the cells may hold one point alone: those of the rim do; more, and cells are too small
_CROSSED = 2  # times: a wall that crosses the slab of a plane has a fifth of its points near it within that reach
_SHARE_BITS = 30
_SMALLER = 10  # times: parts of a table behind what stands on it, and no strays at its height


@inner
def plane_surfaces(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor,  # (B+1,)
    near: Tensor,  # (N,) bool: the points near their cloud's plane
    planes: Tensor,  # (B, 4) float64 on the CPU
    distance: float,
    *,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # patch (N,) bool; corners (B, 24) int64 and rms (B,) float64, on the CPU
    """Mark those of the points near each plane that are of its surface, rather than of walls and things it crosses.

    In square cells of the plane, a surface has its points near the plane, and what crosses it has most of them above
    and below. Cells where points near the plane are less than half as frequent, among those within 5 distances, as
    they are on average are left out; of the others, the connected patches that are a tenth as large as the largest
    are kept. Cells have an edge of 4 distances, doubled until a fifth at most holds one point alone.

    The corners are rows of points of the surface, those of its convex hull in the plane, counterclockwise as seen from
    where the normal points to, and -1 behind the last; where there are more than 24, those that matter least are left
    out. The third result is the RMS distance of the points of the surface from the plane, 0 where there are none.
    """
    patches, corners, rms = [], [], []
    for (start, stop), plane in zip(pairwise(bounds_of(ptr)), planes):
        own, axes = points[start:stop], plane_axes(plane).T.contiguous()
        patches.append(_patch(own, near[start:stop], plane, axes, distance))
        rows, spread = _outline(own, patches[-1], plane, axes)
        corners.append((rows + start).tolist() + [-1] * (MOST_CORNERS - len(rows)))
        rms.append(spread)
    return (
        torch.cat(patches),
        torch.tensor(corners, dtype=torch.int64, device="cpu").reshape(-1, MOST_CORNERS),
        torch.tensor(rms, dtype=torch.float64, device="cpu"),
    )


def _patch(points: Tensor, near: Tensor, plane: Tensor, axes: Tensor, distance: float) -> Tensor:  # (n,) bool
    """Mark the points near a plane that are of its surface."""
    low, scale, cells = _surface_cells(points, near, plane, axes, distance)
    if not len(cells):
        return near
    return near & cells.reshape(-1)[_cells(_flat(points, axes), low, scale, list(cells.shape))]


def _surface_cells(
    points: Tensor, near: Tensor, plane: Tensor, axes: Tensor, distance: float
) -> tuple[Tensor, float, Tensor]:  # low (2,), cells to a unit, (rows, columns) bool
    """Mark the cells of the surface, and say where cells begin; none at all where no point looked at is near."""
    stride = max(1, len(points) // _MOST_POINTS)
    own, some = near[::stride], points[::stride]
    x, y, z = some.unbind(1)
    a, b, c, d = plane.tolist()
    around = (own | ((((x * a + y * b) + z * c) + d).abs() < _REACH * distance)).nonzero().squeeze(1)
    own = own[around]
    if not bool(own.any()):
        return torch.zeros(2, dtype=torch.float64, device="cpu"), 0.0, own.new_zeros(0, 0)
    flat = _flat(some[around], axes)
    low = flat.amin(1)
    spans = (flat.amax(1) - low).tolist()
    span = max(spans)
    edge = max(_CELL * distance, span / _MOST_CELLS)
    while True:
        size = [int(along / edge) + 5 for along in spans]
        cell = _cells(flat, low, 1 / edge, size)
        count = torch.bincount(cell[own], minlength=size[0] * size[1])
        if int((count == 1).sum()) <= _MOST_LONELY * int((count > 0).sum()) or edge > span / 4:
            break
        edge *= 2
    # Shares in whole numbers: their sum is the same in any order.
    share = (count << _SHARE_BITS) // torch.bincount(cell, minlength=len(count)).clamp_(min=1)
    usual = share * (_CROSSED * count.sum()) >= (count * share).sum()
    kept = _large_patches(((count > 0) & usual).reshape(size))
    # Cells at its rim without any point of those that were looked at.
    kept |= _grown(kept) & (count == 0).reshape(size)
    return low.double().cpu(), 1 / edge, kept


def _outline(points: Tensor, chosen: Tensor, plane: Tensor, axes: Tensor) -> tuple[Tensor, float]:
    """Return the rows of corners of the chosen points, and the RMS distance of these from the plane."""
    rows = chosen.nonzero().squeeze(1)
    own = points[rows].double()
    places = flat_places(own, axes)
    hull = hull_rows(places, backend=REFERENCE)
    kept = _most_corners(places[hull].tolist())
    x, y, z = own.unbind(1)
    a, b, c, d = plane.tolist()
    off = ((x * a + y * b) + z * c) + d
    return rows[hull].cpu()[kept], float(off.square().mean().sqrt()) if len(own) else 0.0


def _most_corners(places: list[list[float]]) -> list[int]:
    """Say which corners stay: again and again the one goes whose triangle with its neighbors is smallest."""
    kept = list(range(len(places)))
    sizes = [_corner_size(places, kept, at) for at in kept] if len(kept) > MOST_CORNERS else []
    while len(kept) > MOST_CORNERS:
        gone = sizes.index(min(sizes))
        del kept[gone], sizes[gone]
        for at in (gone - 1, gone % len(kept)):
            sizes[at] = _corner_size(places, kept, at)
    return kept


def _corner_size(places: list[list[float]], kept: list[int], at: int) -> float:
    """Return twice the area of the triangle of a corner and its neighbors."""
    (left_x, left_y), (x, y), (right_x, right_y) = (places[kept[(at + step) % len(kept)]] for step in (-1, 0, 1))
    return abs((left_x - x) * (right_y - y) - (left_y - y) * (right_x - x))


def flat_places(points: Tensor, axes: Tensor) -> Tensor:  # (n, 2) float64
    """Return places in a plane, by separate operations: every backend gives the same bits."""
    x, y, z = points.double().unbind(1)
    return torch.stack([(x * a + y * b) + z * c for a, b, c in axes.tolist()], dim=1)


def _flat(points: Tensor, axes: Tensor) -> Tensor:  # (2, n)
    """Return places in the plane in the points' own dtype, likewise."""
    x, y, z = points.unbind(1)
    return torch.stack([(x * a + y * b) + z * c for a, b, c in axes.to(points.dtype).tolist()])


def _cells(flat: Tensor, low: Tensor, scale: float, size: list[int]) -> Tensor:
    """Number the cells of places in the plane; beyond each end are two empty ones, the last for all farther away."""
    row, column = (
        ((along - float(start)) * scale).floor_().add_(2).clamp_(0, cells - 1).int()
        for along, start, cells in zip(flat, low, size, strict=True)
    )
    return row * size[1] + column


def _grown(cells: Tensor) -> Tensor:
    """Mark cells and the eight around them."""
    return torch.nn.functional.max_pool2d(cells[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0


def _large_patches(cells: Tensor) -> Tensor:
    """Leave out the connected patches, over corners too, that are small beside the largest."""
    place = cells.nonzero()
    row_of = torch.full((cells.shape[0] + 2, cells.shape[1] + 2), -1, dtype=torch.int64, device=cells.device)
    rows = torch.arange(len(place), dtype=torch.int64, device=cells.device)
    v, u = place.unbind(1)
    row_of[v + 1, u + 1] = rows
    pairs = []
    for down, right in ((0, 1), (1, -1), (1, 0), (1, 1)):  # each pair once
        other = row_of[v + 1 + down, u + 1 + right]
        pairs.append(torch.stack([rows[other >= 0], other[other >= 0]]))
    patch = lowest_rows(torch.cat(pairs, 1), len(rows), cells.device)
    area = torch.bincount(patch, minlength=len(rows))
    large = torch.zeros_like(cells)
    large[v, u] = area[patch] * _SMALLER >= area.max()
    return large
