"""The smallest box around points in space."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.contracts.tensors import check_tensors
from pcdata.errors import TooFewPointsError
from pcdata.functional.hulls import hull_surface

_STARTS = 8  # of the boxes on faces of the hull, the smallest, which are turned further
_TURNS = 20  # times a box is turned about its own axes at most; few need five
_TILTED = 2  # of the boxes that came out, the smallest, which are then tilted freely
_TRIES = 400  # poses that one of them is tried in
_AT_ONCE = 1 << 21  # distances that are alive together
_LEVEL = 1e-9  # cosine below which a face counts as seen edge on


class _Hull(NamedTuple):
    corners: NDArray[np.float64]  # (P, 3)
    normals: NDArray[np.float64]  # (T, 3)
    edges: NDArray[np.int64]  # (E, 2) corners
    beside: NDArray[np.int64] | None  # (E, 2) faces; None = not known, as of a flat hull


def _spiral(count: int) -> NDArray[np.float64]:
    """Return rotations (count, 3, 3) spread evenly over all.

    Source: Alexa, Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3), CVPR 2022.
    """
    step = np.arange(count) + 0.5
    near, far = np.sqrt(step / count), np.sqrt(1 - step / count)
    one, other = 2 * np.pi * step / np.sqrt(2), 2 * np.pi * step / 1.533751168755204288118041
    x, y, z, w = near * np.sin(one), near * np.cos(one), far * np.sin(other), far * np.cos(other)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


_POSES = _spiral(16)


def smallest_box(points: Tensor) -> tuple[Tensor, Tensor]:  # pose (4, 4), size (3,)
    """Return the smallest box around points (N, 3) in space, turned in any way: its pose and its edges, in float64.

    The origin of the pose is the middle of the box, x runs along its longest edge and z along its shortest. Every box
    with a side on a face of the convex hull is looked at, each turned in that side as well as can be; the smallest of
    them, and others from poses that are spread evenly, are turned about their own axes, and the best tilted freely,
    as long as they grow smaller. So nothing near the box is smaller, and what is elsewhere hardly ever is, by little.
    Points in a plane have a box of no height.

    Raises:
        ShapeError, DTypeError, NonFiniteError: the points are not (N, 3) finite numbers.
        TooFewPointsError: there are none.

    Source: O'Rourke, Finding minimal enclosing boxes, International Journal of Computer and Information Sciences 14(3),
    1985; turned and tilted as in Chang, Gorissen and Melchior, Fast oriented bounding box optimization on the rotation
    group SO(3, R), ACM Transactions on Graphics 30(5), 2011.
    """
    check_tensors("smallest_box", {"points": points}, {"points": "N 3 : float"})
    if not len(points):
        raise TooFewPointsError("smallest_box: there are no points")
    rows = points.detach().double().cpu().numpy()
    corners, triangles = hull_surface(rows)
    own = rows[corners]
    middle = own.mean(0)
    scale = float(np.abs(own - middle).max()) or 1.0
    axes = _axes((own - middle) / scale, np.searchsorted(corners, triangles))
    places = (rows - middle) @ axes.T
    low, high = places.min(0), places.max(0)
    order = np.argsort(low - high, kind="stable")  # the longest first
    axes, size, center = axes[order], (high - low)[order], middle + ((low + high) / 2) @ axes
    for axis in axes[:2]:
        axis *= np.sign(axis[np.abs(axis).argmax()])
    axes[2] = np.cross(axes[0], axes[1])
    pose = torch.eye(4, dtype=torch.float64, device="cpu")
    pose[:3, :3], pose[:3, 3] = torch.from_numpy(axes.T.copy()), torch.from_numpy(center)
    return pose, torch.from_numpy(size)


def _axes(corners: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the axes (3, 3) of the smallest box around a hull, in rows."""
    if len(corners) == 1:
        return np.eye(3)
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    area = np.sqrt((across * across).sum(1))
    if not len(triangles):
        return _with_two_more(corners[1] - corners[0])
    flat = across[area.argmax()] / area.max()
    normals = across / np.where(area > 0, area, 1.0)[:, None]
    hull = _Hull(corners, normals, *_edges(triangles))
    if np.abs((corners - corners[0]) @ flat).max() <= 1e-7:  # all in one plane
        return _turned(hull, flat[None])[1][0]
    volume, found = _turned(hull, _distinct(normals[area > 0]))
    best = np.argsort(volume, kind="stable")[:_STARTS]
    volume, found = _descended(hull, np.concatenate([found[best], _POSES]))
    tilted = [_tilted(corners, found[k]) for k in np.argsort(volume, kind="stable")[:_TILTED]]
    volume, found = _descended(hull, np.stack(tilted))
    return found[volume.argmin()]


def _tilted(corners: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Tilt a box (3, 3) in all ways until it grows no smaller: turns about one axis can stop short of that."""
    from scipy.optimize import minimize  # imported late: only this function needs it

    def turned(vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Turn by Cayley's matrix of a vector: twice the tangent of half the angle along the axis."""
        x, y, z = vector / 2
        skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        moved: NDArray[np.float64] = axes @ np.linalg.solve(np.eye(3) + skew, np.eye(3) - skew)
        return moved

    def volume(vector: NDArray[np.float64]) -> float:
        places = turned(vector) @ columns
        return float((places.max(1) - places.min(1)).prod())

    columns = np.ascontiguousarray(corners.T)
    around = np.concatenate([np.zeros((1, 3)), 0.03 * np.eye(3)])  # radians
    options = {"initial_simplex": around, "xatol": 1e-9, "fatol": 1e-15, "maxfev": _TRIES}
    return turned(minimize(volume, np.zeros(3), method="Nelder-Mead", options=options).x)


def _descended(hull: _Hull, starts: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Turn boxes (S, 3, 3) about their own axes until none grows smaller."""
    best, own = np.full(len(starts), np.inf), starts
    open_ = np.arange(len(starts))
    for _ in range(_TURNS):
        volume, found = _turned(hull, own[open_].reshape(-1, 3))
        volume, found = volume.reshape(-1, 3), found.reshape(-1, 3, 3, 3)
        which = volume.argmin(1)
        each = np.arange(len(open_))
        smaller = volume[each, which] < best[open_] * (1 - 1e-9)
        open_ = open_[smaller]
        if not len(open_):
            break
        best[open_] = volume[each, which][smaller]
        own[open_] = found[each, which][smaller]
    return best, own


def _turned(hull: _Hull, normals: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return for every direction (F, 3) the smallest box with an axis along it: its volume (F,), its axes (F, 3, 3).

    A side of it lies on an edge of the hull as seen along the direction, which is one between a face that is turned
    toward the eye and one that is turned away; what is seen outermost are ends of such edges.
    """
    volumes, axes = np.empty(len(normals)), np.empty((len(normals), 3, 3))
    step = max(1, _AT_ONCE // max(1, len(hull.edges)))
    for start in range(0, len(normals), step):
        outline, filled = _outlines(hull, normals[start : start + step])
        within = max(1, _AT_ONCE // (2 * outline.shape[1] ** 2))
        for first in range(0, len(outline), within):
            some = slice(start + first, min(start + first + within, start + step))
            own = slice(first, first + within)
            volumes[some], axes[some] = _on_outlines(hull, normals[some], outline[own], filled[own])
    return volumes, axes


def _on_outlines(
    hull: _Hull, normals: NDArray[np.float64], outline: NDArray[np.int64], filled: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    ends = hull.corners[hull.edges[outline]]  # (F, S, 2, 3)
    along = ends[:, :, 1] - ends[:, :, 0]
    along = along - (along * normals[:, None]).sum(-1, keepdims=True) * normals[:, None]
    length = np.sqrt((along * along).sum(-1))
    usable = filled & (length > _LEVEL)
    along /= np.where(usable, length, 1.0)[..., None]
    aside = np.cross(normals[:, None], along)
    seen = ends.reshape(len(ends), -1, 3).transpose(0, 2, 1)
    area = np.ptp(np.matmul(along, seen), axis=2) * np.ptp(np.matmul(aside, seen), axis=2)
    best = np.where(usable, area, np.inf).argmin(1)
    each = np.arange(len(best))
    height = np.ptp(hull.corners @ normals.T, axis=0)
    return area[each, best] * height, np.stack([normals, along[each, best], aside[each, best]], axis=1)


def _outlines(hull: _Hull, normals: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the edges (F, S) of the hull's outline seen along each direction, and which are more than padding."""
    if hull.beside is not None:
        toward = normals @ hull.normals.T
        one, other = toward[:, hull.beside[:, 0]], toward[:, hull.beside[:, 1]]
        on = ((one <= _LEVEL) & (other >= -_LEVEL)) | ((one >= -_LEVEL) & (other <= _LEVEL))
    else:
        on = np.ones((len(normals), len(hull.edges)), dtype=np.bool_)
    row, edge = np.nonzero(on)
    count = on.sum(1)
    place = np.arange(len(row)) - (np.cumsum(count) - count)[row]
    width = int(count.max(initial=1))
    outline = np.zeros((len(normals), width), dtype=np.int64)
    outline[:] = on.argmax(1)[:, None]
    outline[row, place] = edge
    return outline, np.arange(width) < count[:, None]


def _edges(triangles: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64] | None]:
    """Return the edges (E, 2) of a surface and the two faces (E, 2) beside each, if it is closed and has one side."""
    pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    one, other = pairs[order[::2]], pairs[order[1::2]]
    edges = np.unique(pairs, axis=0)
    if one.shape == other.shape == edges.shape and bool((one == other).all()):
        return edges, np.stack([order[::2] // 3, order[1::2] // 3], axis=1)
    return edges, None


def _distinct(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Leave out directions that repeat another, or its opposite: the triangles of one face."""
    sign = np.sign(np.take_along_axis(normals, np.abs(normals).argmax(1)[:, None], 1))
    _, first = np.unique((normals * sign).round(9), axis=0, return_index=True)
    return normals[np.sort(first)]


def _with_two_more(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return three axes, the first along a direction."""
    first = direction / np.sqrt((direction * direction).sum())
    second = np.cross(first, np.eye(3)[np.abs(first).argmin()])
    second /= np.sqrt((second * second).sum())
    return np.stack([first, second, np.cross(first, second)])
