"""Clouds that show the same thing: copies of one another in another order, thinned out, noisy, or moved as a whole.

Two clouds are near duplicates where each lies on the other: nearly all points of the sparser one are, along the local
normal, as close to the denser one as noise is, and nearly all of the denser one have a point of the sparser one near.
A rigid motion does not matter: a moved copy holds the same answer as the original. Another view of the same object is
no duplicate: what one view shows and the other does not lies apart.

Comparing all pairs is out of reach, so a descriptor that none of that changes much finds the candidates: quantiles of
the distance from the centroid, the standard deviations along the principal axes, and quantiles of how far points are
from the median along each of these (shape distributions after Osada et al., ACM Transactions on Graphics 21(4), 2002,
of the distances to a point and to three planes instead of between points). Its numbers rise and fall together, and how
much a thinned out copy differs in each is a matter of the clouds at hand. So halves of some of them say how it differs,
and descriptors are compared along the directions in which clouds differ most from one another and copies least (linear
discriminant analysis: Fisher, The use of multiple measurements in taxonomic problems, 1936).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

Points = NDArray[np.float64]  # (N, 3)

FEWEST = 100  # points: fewer say too little of a surface

_RADIAL = np.linspace(0.0, 1.0, 18)[1:-1]  # quantiles, without the ends, which single stray points make
_AXIAL = np.linspace(0.0, 1.0, 12)[1:-1]
_NUM_RADIAL = len(_RADIAL) + 3
SIZE = _NUM_RADIAL + 3 * len(_AXIAL)  # numbers of a descriptor

# Directions that descriptors are compared along, and nearest ones that are looked at: along those of all numbers, and
# along those of the numbers without axes, since axes of nearly equal spreads change places in a copy.
_SPACES = ((SIZE, 30, 16, 1.0), (_NUM_RADIAL, 12, 4, 0.7))
# How far descriptors of copies are apart where the noise of n points is 1 / sqrt(n), and how much more where n is
# small: measured on clouds thinned out to a half and a quarter.
_APART, _OF_FEW = 1.3, 16.7
_LEAST_SPREAD = 1e-3  # of the size
_HALVES = 400  # of clouds that tell how copies differ
_RIDGE, _LEAST_NOISE = 1e-3, 1e-4  # what keeps the analysis stable: of the variance of each number, and of any
_BLOCK = 1 << 22  # distances at a time
_NEARLY_ALL = 0.98  # of the points
_NOISE_M = 0.003  # metres: three standard deviations of the noise of a depth camera close by
_NOISE = 0.01  # of the size of a cloud that is in no metres
_OF_SPACING = 0.25  # of the distance of neighbors: between points of a curved surface it is not where its plane is
_BESIDE = 3.0  # distances of neighbors: how far beside a point the next one of an independent sample may be
# Of points of which one in n is kept, none of the next 6 n is with a chance of exp(-6), far below what may be missing.
_KEPT, _COUNTED = 6.0, 24
_MOST = 2048  # points of a cloud that are looked up
_DESCRIBED = 8192  # points that a cloud is described by: more take longer, fewer make more candidates
_ALIGNED = 192  # points that are brought onto the other cloud
_STEPS = 24  # of the alignment, at most
_SNAPS = 4  # times that what is nearly aligned is judged on the way
_ON_THE_WAY = {0: 0.2, 4: 0.4, 8: 0.6, 13: 0.8}  # step -> the share of points that must be near by then
_FIT = 8  # neighbors that a local plane is fitted to


def descriptor(points: Points) -> NDArray[np.float32]:  # (SIZE,)
    """Return what is alike for near duplicates; all zero where there are too few points."""
    return _described(_some(points, _DESCRIBED)) if len(points) >= FEWEST else np.zeros(SIZE, np.float32)


def thinnings(points: Points, count: int, draw: torch.Generator) -> list[NDArray[np.float32]]:  # of (SIZE,)
    """Return how the descriptors of so many random halves of a cloud differ, for points whose noise is 1."""
    points = _some(points, _DESCRIBED)
    whole, size = descriptor(points), len(points)
    halves = [points[torch.randperm(size, generator=draw, device="cpu").numpy()[: size // 2]] for _ in range(count)]
    return [np.asarray((_described(half) - whole) * np.sqrt(size), np.float32) for half in halves]


def thinned(counts: NDArray[np.int64], draw: torch.Generator) -> NDArray[np.int64]:  # (N,)
    """Return how many :func:`thinnings` should be asked of each cloud: several where clouds are few."""
    filled = np.flatnonzero(counts >= FEWEST)
    if 0 < len(filled) < _HALVES:
        rows = np.resize(filled, _HALVES)
    else:
        rows = filled[torch.randperm(len(filled), generator=draw, device="cpu").numpy()[:_HALVES]]
    return np.bincount(rows, minlength=len(counts))


def _described(points: Points) -> NDArray[np.float32]:
    centered = points - points.mean(0)
    variances, axes = np.linalg.eigh(centered.T @ centered / len(points))
    spread = np.sqrt(np.clip(variances, 0.0, None))
    size = float(np.linalg.norm(spread))  # the root of the mean squared distance from the centroid
    lengths = np.concatenate([_quantiles(np.linalg.norm(centered, axis=1), _RADIAL), spread])
    along = centered @ axes
    away = _quantiles(np.abs(along - np.median(along, axis=0)), _AXIAL) / np.maximum(spread, 1e-12)
    lengths = np.log(np.maximum(lengths, max(_LEAST_SPREAD * size, 1e-12)))
    return np.concatenate([lengths, away.T.ravel()]).astype(np.float32)


def _quantiles(values: NDArray[np.float64], shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the quantiles of columns, as ``numpy.quantile`` does, which takes several times as long for few values."""
    ordered = np.sort(values, axis=0)
    place = shares * (len(ordered) - 1)
    below = place.astype(np.int64)
    part = (place - below).reshape(-1, *[1] * (ordered.ndim - 1))
    return ordered[below] * (1 - part) + ordered[np.minimum(below + 1, len(ordered) - 1)] * part


def candidates(
    descriptors: NDArray[np.float32],  # (N, SIZE)
    counts: NDArray[np.int64],  # (N,) points
    parts: Sequence[NDArray[np.int64]],  # rows of each part
    halves: NDArray[np.float32],  # (M, SIZE) of thinnings
) -> Iterator[tuple[int, int]]:
    """Yield pairs of rows of different parts that could be near duplicates, those of the smaller part in turn."""
    filled = [part[counts[part] >= FEWEST] for part in parts]
    counts = np.minimum(counts, _DESCRIBED)
    known = np.concatenate(filled)
    if not len(known):
        return
    spaces = [
        (_compared(descriptors[:, :size], known, halves[:, :size], most), count, share)
        for size, most, count, share in _SPACES
    ]
    order = sorted(range(len(filled)), key=lambda number: len(filled[number]))
    for small, large in itertools.combinations(order, 2):
        asked, others = filled[small], filled[large]
        if not len(others):
            continue
        step = max(1, _BLOCK // len(others))
        for rows in (asked[first : first + step] for first in range(0, len(asked), step)):
            pairs = set[tuple[int, int]]()
            for values, count, share in spaces:
                pairs |= _near(values, counts, rows, others, count, share)
            yield from sorted(pairs)


def _compared(values: NDArray[Any], known: NDArray[np.int64], halves: NDArray[Any], most: int) -> NDArray[np.float64]:
    """Return descriptors along the directions that tell clouds from copies best, where copies differ by 1."""
    from scipy.linalg import eigh

    values, halves = values.astype(np.float64), halves.astype(np.float64)
    within = halves.T @ halves / len(halves)
    within[np.diag_indices_from(within)] *= 1 + _RIDGE
    within[np.diag_indices_from(within)] += _LEAST_NOISE
    centered = values[known] - values[known].mean(0)
    directions = eigh(centered.T @ centered / len(known), within)[1][:, ::-1][:, :most]
    return np.asarray((values - values[known].mean(0)) @ directions / np.sqrt(most))


def _near(
    values: NDArray[np.float64],  # (N, D)
    counts: NDArray[np.int64],  # (N,)
    rows: NDArray[np.int64],
    others: NDArray[np.int64],
    count: int,
    share: float,
) -> set[tuple[int, int]]:
    """Return the pairs of the nearest rows that are no further apart than copies are, times a share."""
    one, two = values[rows], values[others]
    squared = (one**2).sum(1)[:, None] + (two**2).sum(1) - 2 * one @ two.T
    count = min(count, len(others))
    nearest = np.argpartition(squared, count - 1, axis=1)[:, :count]
    near = others[nearest]
    fewer = np.minimum(counts[rows][:, None], counts[near])
    limit = share**2 * (_APART**2 * (1 / counts[rows][:, None] + 1 / counts[near]) + (_OF_FEW / fewer) ** 2)
    row, column = np.nonzero(np.take_along_axis(squared, nearest, 1) <= limit)
    return {*zip(rows[row].tolist(), near[row, column].tolist())}


def duplicate_distance(first: Points, second: Surface) -> float | None:
    """Return how far two near duplicates are apart (root mean square, in their unit); None = they are none.

    Args:
        first: as many points as ``second`` has, or fewer.
        second: the other cloud.
    """
    sparse = _some(first, _MOST)
    few = _some(sparse, _ALIGNED)
    for start in _starts(sparse, second.points):
        motion = start
        for step in range(_STEPS):
            moved = _applied(motion, few)
            near, middle, normal = second.nearest(moved)
            along = np.minimum(np.abs(((middle - moved) * normal).sum(1)), near)
            share = float(((near <= second.reach) & (along <= 3 * second.noise)).mean())
            if share < _ON_THE_WAY.get(step, 0.0):
                break
            if share >= _NEARLY_ALL:
                return _settled(motion, sparse, few, second)
            motion = second.toward(moved, near, middle, normal) @ motion
    return None


def _settled(motion: NDArray[np.float64], sparse: Points, few: Points, second: Surface) -> float | None:
    """Judge clouds that lie on each other but for a little: along a plane, planes do not say where, and points do."""
    for _ in range(_SNAPS):
        moved = _applied(motion, sparse)
        if (found := second.judged(moved)) is not None:
            return found if _covers(moved, second) else None
        for _ in range(_STEPS // _SNAPS):
            motion = second.snapping(_applied(motion, few)) @ motion
    return None


def _applied(motion: NDArray[np.float64], points: Points) -> Points:
    return points @ motion[:3, :3].T + motion[:3, 3]


def _starts(sparse: Points, dense: Points) -> Iterator[NDArray[np.float64]]:
    """Yield the motions to begin with: none, then those that lay the principal axes on each other."""
    yield np.eye(4)
    axes = [np.linalg.eigh(np.cov(points.T))[1] for points in (sparse, dense)]
    axes = [own * np.array([1.0, 1.0, np.linalg.det(own)]) for own in axes]
    for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        rotation = axes[1] @ np.diag(signs) @ axes[0].T
        motion = np.eye(4)
        motion[:3, :3] = rotation
        motion[:3, 3] = dense.mean(0) - rotation @ sparse.mean(0)
        yield motion


def _some(points: Points, count: int) -> Points:
    """Return so many of the points at most, spread over their order."""
    return points[np.linspace(0, len(points) - 1, count).astype(np.int64)] if len(points) > count else points


class Surface:
    """The denser of two clouds, with what counts as near it.

    Args:
        points: its points, :data:`FEWEST` or more.
        in_metres: whether they are in metres, where the noise of depth cameras is known.
    """

    def __init__(self, points: Points, in_metres: bool) -> None:
        from scipy.spatial import cKDTree

        self.points = points
        self._tree: Any = cKDTree(points)
        some = _some(points, 256)
        self.spacing = float(np.median(self._tree.query(some, k=[2])[0]))  # the nearest is the point itself
        size = float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean()))
        self.noise = max(_NOISE_M if in_metres else _NOISE * size, _OF_SPACING * self.spacing)
        self.reach = max(_BESIDE * self.spacing, self.noise)
        self._is_fitted = np.zeros(len(points), bool)  # of which points the local plane is known
        self._middle, self._normal = np.empty_like(points), np.empty_like(points)

    def radius_of(self, points: Points, count: float) -> NDArray[np.float64]:
        """Return how far around each of its points so many others lie: the nearest are counted, more are reckoned."""
        nearest = int(min(np.ceil(count), _COUNTED, len(self.points) - 1))
        distance = self._tree.query(points, k=[nearest + 1])[0][:, 0]  # the nearest is the point itself
        return np.asarray(distance * np.sqrt(count / nearest))  # on a surface their number grows with the area

    def nearest(self, points: Points) -> tuple[NDArray[np.float64], Points, Points]:
        """Return of every point the distance to the nearest one, a point of the local plane there, and its normal."""
        distance, near = self._tree.query(points)
        fresh = np.unique(near[~self._is_fitted[near]])
        if len(fresh):
            self._middle[fresh], self._normal[fresh] = self._fitted(fresh)
            self._is_fitted[fresh] = True
        return distance, self._middle[near], self._normal[near]

    def _fitted(self, rows: NDArray[np.int64]) -> tuple[Points, Points]:
        own = self.points[self._tree.query(self.points[rows], k=[*range(1, _FIT + 1)])[1]]
        middle = own.mean(1)
        centered = own - middle[:, None]
        return middle, np.linalg.eigh(np.einsum("nki,nkj->nij", centered, centered))[1][:, :, 0]

    def offsets(self, points: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return of every point the distance to the nearest one, and along the normal there to the local plane."""
        distance, middle, normal = self.nearest(points)
        along = np.abs(((middle - points) * normal).sum(1))
        return distance, np.minimum(along, distance)  # at an edge a copy is on the point, if not on the plane

    def judged(self, points: Points) -> float | None:
        """Return the root mean square distance where nearly all points lie on the surface; else None."""
        distance, along = self.offsets(points)
        on_it = (along <= self.noise) & (distance <= self.reach)
        return float(np.sqrt((along**2).mean())) if on_it.mean() >= _NEARLY_ALL else None

    def toward(
        self, points: Points, distance: NDArray[np.float64], plane: Points, normal: Points
    ) -> NDArray[np.float64]:
        """Return the motion (4, 4) that brings points onto the surface, as :meth:`nearest` told: one step.

        Source: Chen and Medioni, Object modelling by registration of multiple range images, 1992.
        """
        near = distance <= max(self.reach, float(np.quantile(distance, 0.8)))
        plane, normal = plane[near], normal[near]
        middle = points.mean(0)
        rows = np.hstack([np.cross(points[near] - middle, normal), normal])
        turn = np.linalg.lstsq(rows, ((plane - points[near]) * normal).sum(1), rcond=1e-6)[0]
        cross = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
        left, _, right = np.linalg.svd(np.eye(3) + cross)
        motion = np.eye(4)
        motion[:3, :3] = left @ right
        motion[:3, 3] = middle + turn[3:] - motion[:3, :3] @ middle
        return motion

    def snapping(self, points: Points) -> NDArray[np.float64]:
        """Return the motion (4, 4) that brings points onto their nearest ones: one step.

        Source: Arun et al., Least-squares fitting of two 3-D point sets, PAMI 9(5), 1987.
        """
        near = self.points[self._tree.query(points)[1]]
        left, _, right = np.linalg.svd((near - near.mean(0)).T @ (points - points.mean(0)))
        motion = np.eye(4)
        motion[:3, :3] = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        motion[:3, 3] = near.mean(0) - motion[:3, :3] @ points.mean(0)
        return motion


def _covers(points: Points, surface: Surface) -> bool:
    """Whether nearly all of the denser cloud has a point of the sparser one near, for its own density or the local one.

    A cloud of a camera is dense on what is near and sparse on the rest; one that was thinned out evenly has its points
    as far apart as the sparser one's are anywhere.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    spacing = float(np.median(tree.query(_some(points, 256), k=[2])[0]))
    some = _some(surface.points, _MOST)
    distance, _ = tree.query(some)
    near = np.maximum(surface.radius_of(some, _KEPT * len(surface.points) / len(points)), _BESIDE * spacing)
    return bool((distance <= np.maximum(near, surface.noise)).mean() >= _NEARLY_ALL)
