"""DBSCAN on ragged batches, label for label as Open3D gives them.

Source: Ester et al., A density-based algorithm for discovering clusters, KDD 1996.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.numbers import checked_count, checked_lengths, require_length
from pcdata.contracts.on_host import bounds_of
from pcdata.functional.image_grid import ImageGrid, checked_grid
from pcdata.functional.nearest import pair_chunks
from pcdata.functional.neighbor_rows import nearest_rows
from pcdata.functional.neighbors import ball_query, radius_neighbors
from pcdata.functional.radius import require_extent, squared_radius
from pcdata.functional.rows import cloud_of_rows, ptr_after_mask, ptr_from_counts, segment_sum


def checked_eps(where: str, name: str, arguments: Mapping[str, Any]) -> Tensor:
    """Require one length for every cloud, or one per cloud (B,); bodies get (B,) float64."""
    value: Any = arguments[name]
    if not isinstance(value, (Tensor, list, tuple)):
        require_length(where, name, value)
    lengths = checked_lengths(where, name, arguments)
    for extreme in (lengths.min().item(), lengths.max().item()):
        require_length(where, name, extreme)
    return lengths


@inner
def density_clusters(
    points: Tensor, ptr: Tensor, eps: float, min_points: int, grid: ImageGrid | None, *, backend: str = "auto"
) -> Tensor:
    """Return the labels that :func:`dbscan` gives for one eps and points that all count 1."""
    require_extent("dbscan", points, ptr, eps)
    limit = squared_radius(eps, points.device)
    core = torch.empty(len(points), dtype=torch.bool, device=points.device)
    for pairs in pair_chunks(points, ptr, points, ptr):
        core[pairs.query] = (pairs.squared < limit).sum(1) >= min_points
    label = torch.full_like(core, -1, dtype=torch.int64)
    for start, stop in pairwise(bounds_of(ptr)):
        rows = start + core[start:stop].nonzero().squeeze(1)
        label[rows] = _clusters(points[rows], limit)
    # Borders take the lowest label of the core points in reach.
    cores, borders, none = core.nonzero().squeeze(1), (~core).nonzero().squeeze(1), len(points)
    for pairs in pair_chunks(points[cores], ptr_after_mask(core, ptr), points[borders], ptr_after_mask(~core, ptr)):
        if len(pairs.row):
            lowest = torch.where(pairs.squared < limit, label[cores[pairs.row]], none).amin(1)
            label[borders[pairs.query]] = torch.where(lowest < none, lowest, -1)
    return label


@op(
    points="N 3",
    ptr="ptr N B",
    weights="N",
    eps=checked_eps,
    min_points=checked_count,
    grid=checked_grid,
    steps=(density_clusters, nearest_rows),
    gradient=False,
)
def dbscan(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    eps: float | Sequence[float] | Tensor = 0.02,
    min_points: int = 50,
    weights: Tensor | None = None,  # (N,) float32
    grid: ImageGrid | None = None,
    backend: str = "auto",
) -> Tensor:  # (N,) int64 label, -1 = noise
    """Cluster each cloud by density; labels start at 0 in every cloud.

    A core point has at least ``min_points`` points, itself included, with d < eps (strict, as
    ``d2 < float32(eps) * float32(eps)``): :func:`core_point_mask` gives them. Core points with d < eps share a cluster;
    clusters are numbered by their lowest core row. A border point takes the lowest label among the core points in its
    reach; all else is noise.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers of the points.
        eps: in the unit of the points; one, or one per cloud (B,).
        min_points: neighbors that make a core point, itself included; with weights the least sum of theirs.
        weights: how much each point counts, as a point that stands for several does; None = 1.
        grid: the depth image the points still lie on; same answers, lets kernels search pixel windows.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
        ConfigError: min_points is less than 1, eps is not a positive length, or it is too small for the extent of a
            cloud (see :mod:`pcdata.functional.radius`).
    """
    assert ptr is not None  # @op fills it
    assert isinstance(eps, Tensor)  # and makes it one per cloud
    if weights is None:
        return _with_each_eps(points, ptr, eps, min_points, grid, backend)
    core = _core_points(points, ptr, eps, min_points, weights, grid, backend)
    cores, borders = core.nonzero().squeeze(1), (~core).nonzero().squeeze(1)
    core_ptr, border_ptr = ptr_after_mask(core, ptr), ptr_after_mask(~core, ptr)
    label = torch.full_like(core, -1, dtype=torch.int64)
    label[cores] = _with_each_eps(points[cores], core_ptr, eps, 1, None, backend)  # all of them cores: what they reach
    reach = eps[cloud_of_rows(border_ptr)]
    index, _, found_ptr = radius_neighbors(
        points[cores], core_ptr, radius=reach, queries=points[borders], queries_ptr=border_ptr, backend=_search(backend)
    )
    none = len(points)
    lowest = torch.full((len(borders),), none, dtype=torch.int64, device=points.device)
    lowest.scatter_reduce_(0, cloud_of_rows(found_ptr), label[cores[index]], "amin")
    label[borders] = torch.where(lowest < none, lowest, -1)
    return label


@op(
    points="N 3",
    ptr="ptr N B",
    weights="N",
    eps=checked_eps,
    min_points=checked_count,
    grid=checked_grid,
    steps=(nearest_rows,),
    gradient=False,
)
def core_point_mask(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    eps: float | Sequence[float] | Tensor = 0.02,
    min_points: int = 50,
    weights: Tensor | None = None,  # (N,) float32
    grid: ImageGrid | None = None,
    backend: str = "auto",
) -> Tensor:  # (N,) bool
    """Mark the core points of :func:`dbscan`: those with enough points, or weight, within eps of them.

    Args:
        points: as there.
        ptr: as there.
        eps: as there.
        min_points: as there.
        weights: as there.
        grid: as there.
        backend: as there.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError, ConfigError: as there.
    """
    assert ptr is not None  # @op fills it
    assert isinstance(eps, Tensor)  # and makes it one per cloud
    return _core_points(points, ptr, eps, min_points, weights, grid, backend)


def _core_points(
    points: Tensor,
    ptr: Tensor,
    eps: Tensor,
    min_points: int,
    weights: Tensor | None,
    grid: ImageGrid | None,
    backend: str,
) -> Tensor:
    radius, search = eps[cloud_of_rows(ptr)], _search(backend)
    if weights is None:
        most = min(min_points, max(len(points), 1))
        _, _, count = ball_query(points, ptr, radius=radius, max_neighbors=most, grid=grid, backend=search)
        return count >= min_points
    index, _, found_ptr = radius_neighbors(points, ptr, radius=radius, grid=grid, backend=search)
    return segment_sum(weights[index], found_ptr) >= min_points


def _search(backend: str) -> str:
    """Return who searches for a backend of clustering."""
    return backend if backend in ("torch", "torch_tree") else "auto"


def _with_each_eps(
    points: Tensor, ptr: Tensor, eps: Tensor, min_points: int, grid: ImageGrid | None, backend: str
) -> Tensor:
    """Cluster the clouds of each eps together."""
    values = eps.unique().tolist()
    if len(values) == 1:
        label: Tensor = density_clusters(points, ptr, values[0], min_points, grid, backend=backend)
        return label
    label = torch.full((len(points),), -1, dtype=torch.int64, device=points.device)
    for value in values:
        mask = (eps == value)[cloud_of_rows(ptr)]
        label[mask] = density_clusters(
            points[mask], ptr_after_mask(mask, ptr), value, min_points, None, backend=backend
        )
    return label


def _clusters(cores: Tensor, limit: Tensor) -> Tensor:
    """Label the core points (M, 3) of one cloud: the lowest without a label starts a cluster, which grows outwards."""
    label = torch.full_like(cores[:, 0], -1, dtype=torch.int64)
    open_ = torch.arange(len(cores), dtype=torch.int64, device=cores.device)  # without a label, ascending
    number = 0
    while len(open_):
        newest, open_ = open_[:1], open_[1:]
        while len(newest):
            label[newest] = number
            reached = torch.zeros_like(open_, dtype=torch.bool)
            newest_ptr, open_ptr = (ptr_from_counts([len(rows)], device=cores.device) for rows in (newest, open_))
            for pairs in pair_chunks(cores[newest], newest_ptr, cores[open_], open_ptr):
                reached[pairs.query] = (pairs.squared < limit).any(1)
            newest, open_ = open_[reached], open_[~reached]
        number += 1
    return label
