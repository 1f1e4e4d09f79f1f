"""Which rows are neighbors: the two searches that backends have kernels for, and how to make one of the other.

The conventions are those of :mod:`pcdata.functional.neighbors`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.nearest import nearest_chunks, rooted, squared_distance
from pcdata.functional.rows import ptr_from_counts

# What finds the nearest rows of stated points: nearest_rows, with its points.
Find = Callable[..., tuple[Tensor, Tensor]]

# All neighbors of every query: index (E,) int64, distance (E,) float32, neighbors_ptr (Q+1,).
Listed = tuple[Tensor, Tensor, Tensor]

# Neighbors of a query that grown_within asks for at first, and places in a table that it fills at once.
_FIRST, _PLACES = 32, 1 << 22


@inner
def nearest_rows(
    points: Tensor,  # (N, D) float32
    ptr: Tensor,  # (B+1,)
    k: int,
    *,
    queries: Tensor | None = None,  # (Q, D) float32; None = the points
    queries_ptr: Tensor | None = None,
    radius: float | Tensor | None = None,  # or (Q,) float32
    grid: ImageGrid | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # index (Q, k) int64, distance (Q, k) float32
    """Find the k nearest points of its own cloud (with d < radius) for every query; padding is (N, infinity)."""
    return laid_out(
        nearest_chunks(points, ptr, k, queries=queries, queries_ptr=queries_ptr, radius=radius, backend="torch"),
        (points if queries is None else queries).shape[0],
        k,
        points.device,
    )


@inner
def rows_within(
    points: Tensor,  # (N, D) float32
    ptr: Tensor,  # (B+1,)
    radius: float | Tensor,  # or (Q,) float32
    *,
    queries: Tensor | None = None,  # (Q, D) float32; None = the points
    queries_ptr: Tensor | None = None,
    exclude_self: bool = False,
    grid: ImageGrid | None = None,
    backend: str = "auto",
) -> Listed:
    """Find all points of its own cloud with d < radius for every query."""
    search = functools.partial(nearest_rows, points, ptr, grid=grid, backend="torch")
    return grown_within(search, points, ptr, radius, queries, queries_ptr, exclude_self)


def laid_out(chunks: Any, num_queries: int, k: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Put the neighbors that chunks name into (Q, k) rows and distances."""
    index = torch.empty((num_queries, k), dtype=torch.int64, device=device)
    distance = torch.empty((num_queries, k), dtype=torch.float32, device=device)
    for query, squared, nearest in chunks:
        index[query] = nearest
        distance[query] = rooted(squared)
    return index, distance


def grown_within(
    find: Find,
    points: Tensor,
    ptr: Tensor,
    radius: float | Tensor,
    queries: Tensor | None,
    queries_ptr: Tensor | None,
    exclude_self: bool,
) -> Listed:
    """List all neighbors by asking for the nearest few, and for four times as many of the queries that had all those.

    For backends that find a stated number of neighbors alone.
    """
    asked, asked_ptr = (points, ptr) if queries is None or queries_ptr is None else (queries, queries_ptr)
    open_ = torch.arange(len(asked), dtype=torch.int64, device=points.device)
    largest = int((ptr[1:] - ptr[:-1]).max())
    width, parts = min(_FIRST, max(largest, 1)), []
    while len(open_):
        full = []
        for query in open_.split(max(1, _PLACES // width)):
            everyone = len(query) == len(asked)
            own: dict[str, Any] = {}
            if not everyone or queries is not None:
                bounds = torch.searchsorted(query, asked_ptr.contiguous())
                own = {"queries": asked[query], "queries_ptr": bounds}
            limit = radius if isinstance(radius, float) else radius[query]
            index, distance = (find if everyone else _without_grid(find))(width, **own, radius=limit)
            found = index < len(points)
            more = found[:, -1] & (width < largest)
            full.append(query[more])
            place = (found & ~more[:, None]).nonzero()
            parts.append((query[place[:, 0]], index[place.unbind(1)], distance[place.unbind(1)]))
        open_, width = torch.cat(full), min(4 * width, largest)
    query, index, distance = (torch.cat(values) for values in zip(*parts)) if parts else (open_, open_, open_.float())
    if exclude_self:
        query, index, distance = (values[index != query] for values in (query, index, distance))
    order = query.argsort(stable=True)  # entries of one query are from one table, in order
    query, index, distance = query[order], index[order], distance[order]
    return index, distance, ptr_from_counts(torch.bincount(query, minlength=len(asked)))


def _without_grid(find: Find) -> Find:
    """The grid says where the points lie, not where other queries do."""
    if isinstance(find, functools.partial) and "grid" in find.keywords:
        return functools.partial(find, grid=None)
    return find


def widest(radius: float | Tensor | None) -> float | None:
    """Return the largest of the radii of some queries, (Q,) or one for all; None where there is none."""
    if isinstance(radius, Tensor):
        return float(radius.max()) if len(radius) else None
    return radius


def cut_to_radii(
    found: tuple[Tensor, Tensor], points: Tensor, queries: Tensor | None, radius: Tensor
) -> tuple[Tensor, Tensor]:
    """Drop what lies outside the radius of its query (Q,) from neighbors within the largest."""
    index, distance = found
    if not len(points):
        return found
    squared = squared_distance(
        (points if queries is None else queries)[:, None], points[index.clamp(max=len(points) - 1)]
    )
    outside = squared >= (radius * radius)[:, None]
    return index.masked_fill(outside, len(points)), distance.masked_fill(outside, torch.inf)
