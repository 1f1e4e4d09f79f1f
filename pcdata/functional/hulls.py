"""The convex hull of points in space."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.contracts.tensors import check_tensors

_FLAT = 1e-7  # as a part of a set's extent: thinner than this it has a dimension less


class ConvexHull(NamedTuple):
    """The convex hull of N points, on the CPU."""

    corners: Tensor  # (P,) int64 rows, rising
    triangles: Tensor  # (T, 3) int64 rows, counterclockwise seen from outside
    volume: float  # in the cube of the points' unit
    area: float  # of the surface


def convex_hull_3d(
    points: Tensor,  # (N, 3) float
) -> ConvexHull:
    """Return the convex hull of points in space: its corners, its surface in triangles, volume and area.

    Points inside of faces and edges are no corners, up to rounding in float64. A set in a plane has no volume, and its
    triangles cover it from both sides; one on a line has two corners, and points that are all equal one: the first.

    Raises:
        ShapeError, DTypeError, NonFiniteError: the points are not (N, 3) finite numbers.

    Source: Barber, Dobkin and Huhdanpaa, The quickhull algorithm for convex hulls, ACM TOMS 22(4), 1996; SciPy's.
    """
    check_tensors("convex_hull_3d", {"points": points}, {"points": "N 3 : float"})
    rows = points.detach().double().cpu().numpy()
    corners, triangles = hull_surface(rows)
    a, b, c = (rows[triangles[:, k]] for k in range(3))
    middle = rows[corners].mean(0) if len(corners) else np.zeros(3)
    across = np.cross(b - a, c - a)
    volume = float(((a - middle) * across).sum()) / 6
    return ConvexHull(
        corners=torch.from_numpy(corners),
        triangles=torch.from_numpy(triangles),
        volume=max(volume, 0.0),
        area=float(np.sqrt((across * across).sum(1)).sum()) / 2,
    )


def hull_surface(points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows of corners (P,) and of triangles (T, 3) of the convex hull of points (N, 3)."""
    none = np.empty((0, 3), dtype=np.int64)
    if not len(points):
        return np.empty(0, dtype=np.int64), none
    low, high = points.min(0), points.max(0)
    extent = float((high / 2 - low / 2).max())
    if extent == 0:
        return np.zeros(1, dtype=np.int64), none
    places = (points - (low / 2 + high / 2)) / extent  # Qhull's limits are for numbers about 1
    dimensions, axes = _dimensions(places)
    if dimensions == 3 and (found := _quickhull(places)) is not None:
        return found[0], _outward(places, *found)
    if dimensions >= 2 and (found := _quickhull(places @ axes[:, 1:])) is not None:
        corners, around = found
        return corners, _both_sides(around)
    along = places @ axes[:, 2]
    return np.unique([along.argmin(), along.argmax()]).astype(np.int64), none


def _outward(
    places: NDArray[np.float64], corners: NDArray[np.int64], triangles: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Turn the triangles of a hull so that their corners are counterclockwise seen from outside."""
    a, b, c = (places[triangles[:, k]] for k in range(3))
    rise = ((a - places[corners].mean(0)) * np.cross(b - a, c - a)).sum(1)
    turned = np.where(rise[:, None] < 0, triangles[:, [0, 2, 1]], triangles)
    if len(np.unique(_directed(turned), axis=0)) == 3 * len(turned):
        return turned
    # Some triangles are so thin that rounding decides: each must run against its neighbors along their common edge.
    beside: dict[tuple[int, int], list[int]] = {}
    for number, (one, other) in enumerate(_directed(turned).tolist()):
        beside.setdefault((min(one, other), max(one, other)), []).append(number // 3)
    fixed = turned.tolist()
    done, stack = {int(np.abs(rise).argmax())}, [int(np.abs(rise).argmax())]
    while stack:
        first, second, third = fixed[stack.pop()]
        for one, other in ((first, second), (second, third), (third, first)):
            for near in beside[min(one, other), max(one, other)]:
                if near in done:
                    continue
                x, y, z = fixed[near]
                if (one, other) in ((x, y), (y, z), (z, x)):
                    fixed[near] = [x, z, y]
                done.add(near)
                stack.append(near)
    return np.array(fixed, dtype=np.int64)


def _directed(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the edges (3 T, 2) of triangles, in their direction."""
    return triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _dimensions(places: NDArray[np.float64]) -> tuple[int, NDArray[np.float64]]:
    """Return how many dimensions a set has, and its principal axes (3, 3), the one of its largest extent last."""
    centered = places - places.mean(0)
    squares, axes = np.linalg.eigh(centered.T @ centered)
    return int((squares > _FLAT**2 * squares[2]).sum()), axes


def _quickhull(places: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """Return corners and simplices of points (n, 2 or 3); None where they are flat to Qhull's eyes."""
    from scipy.spatial import ConvexHull as Quickhull  # imported late: only hulls need it
    from scipy.spatial import QhullError

    try:
        hull = Quickhull(places)
    except QhullError:  # flat to its eyes
        return None
    if places.shape[1] == 2:
        return np.sort(hull.vertices).astype(np.int64), hull.vertices.astype(np.int64)
    return np.sort(hull.vertices).astype(np.int64), hull.simplices.astype(np.int64)


def _both_sides(around: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return triangles that cover a convex polygon, given its corners in order, once from each side."""
    fan = np.stack([np.full(len(around) - 2, around[0]), around[1:-1], around[2:]], axis=1)
    return np.concatenate([fan, fan[:, [0, 2, 1]]])
