"""Nearest neighbors and neighbors within a radius, exact, on ragged batches.

One convention for all: a point counts itself unless ``exclude_self``; squared distance is ((dx*dx)+(dy*dy))+(dz*dz) in
float32, and so on for more columns; neighbors ascend by (squared distance, row), so equal distances go to the lowest
row; missing neighbors are padded with distance infinity and row N, which makes a gather without a mask fail loudly
instead of taking the last point (SciPy's choice). Squared distances must fit in float32: points more than 1.8e19 apart
are never neighbors.

Which points are neighbors is a decision; their distances carry the gradient of the formula to points and queries, 0
where a distance is 0.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count, checked_word, require_length
from pcdata.contracts.operators import Traced
from pcdata.errors import ConfigError, DTypeError, ShapeError
from pcdata.functional.image_grid import ImageGrid, checked_grid
from pcdata.functional.nearest import rooted, squared_distance
from pcdata.functional.neighbor_rows import Find, Listed, nearest_rows, rows_within
from pcdata.functional.norms import NORMS, nearest_in_norm, norm_length, within_in_norm
from pcdata.functional.rows import cloud_of_rows


def checked_radius(where: str, name: str, arguments: Any) -> float | Tensor:
    """Require a positive length for all queries, or one per query (Q,)."""
    value = arguments[name]
    if not isinstance(value, Tensor) or value.ndim == 0:
        value = value.item() if isinstance(value, Tensor) else value
        require_length(where, name, value)
        return float(value)
    queries = arguments["points"] if arguments["queries"] is None else arguments["queries"]
    if value.shape != (len(queries),):
        raise ShapeError(f"{where}: {name} must be one number or one per query ({len(queries)},), {tuple(value.shape)}")
    if not value.dtype.is_floating_point:
        raise DTypeError(f"{where}: {name} must be float, not {value.dtype}")
    for extreme in [value.min().item(), value.max().item()] if len(value) else []:
        require_length(where, name, extreme)
    return value.detach().to(device=queries.device, dtype=torch.float32)


def _found_by(points: Tensor, queries: Tensor | None, k: int) -> tuple[Tensor, Tensor]:
    """Return empty rows and distances like those of k neighbors."""
    shape = (points if queries is None else queries).shape[0], k
    return points.new_empty(shape, dtype=torch.int64), points.new_empty(shape)


@op(
    points="N D",
    ptr="ptr N B",
    queries="Q D",
    queries_ptr="ptr Q B",
    k=checked_count,
    norm=functools.partial(checked_word, words=NORMS),
    grid=checked_grid,
    steps=(nearest_rows, rows_within),
    traced=Traced(
        "Tensor points, Tensor? ptr, int k, Tensor? queries, Tensor? queries_ptr, bool exclude_self, str norm",
        "Tensor index, Tensor distance",
        lambda points, k, queries, **_: _found_by(points, queries, k),
    ),
)
def knn(
    points: Tensor,  # (N, D) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    k: int,
    queries: Tensor | None = None,  # (Q, D) float32; None = the points themselves
    queries_ptr: Tensor | None = None,  # (B+1,); None = one cloud
    exclude_self: bool = False,
    norm: str = "l2",
    grid: ImageGrid | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # index (Q, k) int64 rows of points; distance (Q, k) float32
    """Find the k nearest points of its own cloud for every query.

    A cloud with fewer than k points fills the rest with index N and distance infinity. Any number of columns will do;
    on the CPU all are searched by trees, three by image windows too, and elsewhere others than three by all pairs.

    Args:
        points: the clouds to search, in any unit of length; distances are in the same unit.
        ptr: row pointers of the points.
        k: neighbors per query, the point itself included when the queries are the points.
        queries: where to search from.
        queries_ptr: row pointers of the queries: query cloud b searches point cloud b.
        exclude_self: no point is its own neighbor, though a repeat of it is; only where the queries are the points.
        norm: distances: "l2", straight; "l1", |dx| + |dy| + |dz|; or "linf", the largest of the three.
        grid: the depth image the points still lie on; same answers, lets kernels search pixel windows.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
        ConfigError: k is less than 1, or exclude_self with other queries.
    """
    assert ptr is not None  # @op fills it
    find = finder(points, ptr, grid, backend, norm)
    return nearest("knn", find, points, k, queries, queries_ptr, None, exclude_self, norm)


@op(
    points="N D",
    ptr="ptr N B",
    queries="Q D",
    queries_ptr="ptr Q B",
    radius=checked_radius,
    max_neighbors=checked_count,
    norm=functools.partial(checked_word, words=NORMS),
    grid=checked_grid,
    steps=(nearest_rows, rows_within),
    traced=Traced(
        "Tensor points, Tensor? ptr, float radius, int max_neighbors, Tensor? queries, Tensor? queries_ptr, "
        "bool exclude_self, str norm",
        "Tensor index, Tensor distance, Tensor count",
        lambda points, queries, max_neighbors, **_: (
            *_found_by(points, queries, max_neighbors),
            points.new_empty((points if queries is None else queries).shape[0], dtype=torch.int64),
        ),
    ),
)
def ball_query(
    points: Tensor,  # (N, D) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    radius: float | Tensor,  # or (Q,) float
    max_neighbors: int,
    queries: Tensor | None = None,  # (Q, D) float32; None = the points themselves
    queries_ptr: Tensor | None = None,  # (B+1,); None = one cloud
    exclude_self: bool = False,
    norm: str = "l2",
    grid: ImageGrid | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # index (Q, m) int64; distance (Q, m) float32; count (Q,) int64
    """Find the *nearest* ``max_neighbors`` points with d < radius for every query, never just the first ones met.

    The test is ``d2 < float32(radius) * float32(radius)``, strict. ``count`` is the number of neighbors returned:
    min(points within the radius, max_neighbors). The rest is padded with index N and distance infinity.

    Args:
        points: the clouds to search, in any unit of length.
        ptr: row pointers of the points.
        radius: in the unit of the points; one, or one per query.
        max_neighbors: at most this many per query, the point itself included when the queries are the points.
        queries: where to search from.
        queries_ptr: row pointers of the queries: query cloud b searches point cloud b.
        exclude_self: no point is its own neighbor, though a repeat of it is; only where the queries are the points.
        norm: distances: "l2", straight; "l1", |dx| + |dy| + |dz|; or "linf", the largest of the three.
        grid: the depth image the points still lie on; same answers, lets kernels search pixel windows.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
        ConfigError: the radius is not a positive length, max_neighbors is less than 1, or exclude_self with other
            queries.
    """
    assert ptr is not None  # @op fills it
    find = finder(points, ptr, grid, backend, norm)
    found = nearest("ball_query", find, points, max_neighbors, queries, queries_ptr, radius, exclude_self, norm)
    return *found, (found[0] < len(points)).sum(1)


@op(
    points="N D",
    ptr="ptr N B",
    queries="Q D",
    queries_ptr="ptr Q B",
    radius=checked_radius,
    norm=functools.partial(checked_word, words=NORMS),
    grid=checked_grid,
    steps=(rows_within,),
)
def radius_neighbors(
    points: Tensor,  # (N, D) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    radius: float | Tensor,  # or (Q,) float
    queries: Tensor | None = None,  # (Q, D) float32; None = the points themselves
    queries_ptr: Tensor | None = None,  # (B+1,); None = one cloud
    exclude_self: bool = False,
    norm: str = "l2",
    grid: ImageGrid | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # index (E,) int64; distance (E,) float32; neighbors_ptr (Q+1,)
    """Find *all* points with d < radius for every query: query q has entries neighbors_ptr[q]:neighbors_ptr[q+1].

    As :func:`ball_query`, without a limit and without padding (compressed sparse rows, as Open3D's
    ``fixed_radius_search``): memory grows with the number of pairs.

    Args:
        points: the clouds to search, in any unit of length.
        ptr: row pointers of the points.
        radius: in the unit of the points; one, or one per query.
        queries: where to search from.
        queries_ptr: row pointers of the queries: query cloud b searches point cloud b.
        exclude_self: no point is its own neighbor, though a repeat of it is; only where the queries are the points.
        norm: distances: "l2", straight; "l1", |dx| + |dy| + |dz|; or "linf", the largest of the three.
        grid: the depth image the points still lie on; same answers, lets kernels search pixel windows.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
        ConfigError: the radius is not a positive length, or exclude_self with other queries.
    """
    assert ptr is not None  # @op fills it
    find = functools.partial(rows_within, points.detach(), ptr, grid=grid, backend=backend)
    if norm != "l2":
        find = functools.partial(within_in_norm, points.detach(), ptr, norm, rows_within, backend=backend)
    return all_within("radius_neighbors", find, points, queries, queries_ptr, radius, exclude_self, norm)


# -- shared by the functions above and by the index ------------------------------------------------------------------


def finder(points: Tensor, ptr: Tensor, grid: ImageGrid | None, backend: str, norm: str = "l2") -> Find:
    """Return what finds the nearest rows of these points."""
    if norm != "l2":
        searches = nearest_rows, rows_within
        return functools.partial(nearest_in_norm, points.detach(), ptr, norm, searches, backend=backend)
    return functools.partial(nearest_rows, points.detach(), ptr, grid=grid, backend=backend)


def all_within(
    where: str,
    find: Callable[..., Listed],
    points: Tensor,
    queries: Tensor | None,
    queries_ptr: Tensor | None,
    radius: float | Tensor,
    exclude_self: bool,
    norm: str = "l2",
) -> Listed:
    """Return what :func:`radius_neighbors` does, by whatever finds the neighbors among the points."""
    _require_own_queries(where, exclude_self, queries)
    own = {} if queries is None else {"queries": queries.detach(), "queries_ptr": queries_ptr}
    index, distance, neighbors_ptr = find(radius, **own, exclude_self=exclude_self)
    if _wants_gradient(points, queries):
        query = cloud_of_rows(neighbors_ptr)
        distance = _distance((points if queries is None else queries)[query], points[index], norm)
    return index, distance, neighbors_ptr


def nearest(
    where: str,
    find: Find,
    points: Tensor,
    k: int,
    queries: Tensor | None,
    queries_ptr: Tensor | None,
    radius: float | Tensor | None,
    exclude_self: bool,
    norm: str = "l2",
) -> tuple[Tensor, Tensor]:
    """Return what :func:`knn` does, within a radius if there is one, by whatever finds the nearest among the points."""
    _require_own_queries(where, exclude_self, queries)
    own = {} if queries is None else {"queries": queries.detach(), "queries_ptr": queries_ptr}
    index, distance = find(k + exclude_self, **own, radius=radius)
    if exclude_self:
        itself = index == torch.arange(len(points), dtype=torch.int64, device=points.device)[:, None]
        itself[:, -1] |= ~itself.any(1)  # more repeats than were asked for: the last one is too many
        index, distance = (values[~itself].reshape(-1, k) for values in (index, distance))
    if _wants_gradient(points, queries) and len(points):
        found = index < len(points)
        asked = points if queries is None else queries
        apart = _distance(asked[:, None], points[index.clamp(max=len(points) - 1)], norm)
        distance = torch.where(found, apart, torch.inf)
    return index, distance


def _require_own_queries(where: str, exclude_self: bool, queries: Tensor | None) -> None:
    if exclude_self and queries is not None:
        raise ConfigError(
            f"{where}: exclude_self means nothing for queries of their own; leave queries out, or drop the neighbors "
            "at distance 0 afterwards"
        )


def _wants_gradient(*tensors: Tensor | None) -> bool:
    return torch.is_grad_enabled() and any(tensor is not None and tensor.requires_grad for tensor in tensors)


def _distance(a: Tensor, b: Tensor, norm: str = "l2") -> Tensor:
    """Return float32 distances of rows with a gradient, 0 where they are 0; the bits are those of the search."""
    if norm != "l2":
        return norm_length(a - b, norm)
    squared = squared_distance(a, b)
    apart = squared > 0
    return torch.where(apart, rooted(torch.where(apart, squared, 1.0)), 0.0)
