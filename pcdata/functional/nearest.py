"""Distances between points, and the nearest of them: every pair is looked at, a bounded number of pairs at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.contracts.on_host import bounds_of
from pcdata.functional.radius import squared_radius
from pcdata.threads import at_once

_PAIRS = 1 << 20  # looked at together: a few images of 4 MB


# The neighbors of some queries, ascending by (squared distance, row), k of each; padding is (inf, N): rows of the
# caller's queries (m,) int64, squared distances (m, k) float32, rows of the caller's points (m, k) int64.
Neighbors = tuple[Tensor, Tensor, Tensor]


def rooted(squared: Tensor) -> Tensor:
    """Return float32 distances, correctly rounded: torch's own square root is one unit off for a fifth of numbers."""
    return squared.double().sqrt().float()


@inner
def nearest_chunks(
    points: Tensor,  # (N, D) float32
    ptr: Tensor,  # (B+1,)
    k: int,
    *,
    queries: Tensor | None = None,  # (Q, D) float32; None = the points
    queries_ptr: Tensor | None = None,  # (B+1,)
    radius: float | Tensor | None = None,  # or (Q,) float32
    backend: str = "auto",
) -> Iterator[Neighbors]:
    """Yield every query's k nearest points of its own cloud (with d < radius), each query once, in no fixed order.

    A query that is one of the points counts itself.
    """
    points = points.detach()
    if queries is None or queries_ptr is None:
        queries, queries_ptr = points, ptr
    limit = squared_radius(radius, points.device)
    infinity = torch.full((), torch.inf, dtype=torch.float32, device=points.device)
    missing = _order(infinity, torch.full((), len(points), dtype=torch.int64, device=points.device))
    for pairs in pair_chunks(points, ptr, queries.detach(), queries_ptr):
        below = limit[pairs.query, None] if limit.ndim else limit
        order = torch.where(pairs.squared < below, _order(pairs.squared, pairs.row), missing)
        nearest = order.topk(min(k, len(pairs.row)), largest=False).values
        padded = torch.cat([nearest, missing.expand(len(nearest), k - nearest.shape[1])], dim=1)
        yield pairs.query, (padded >> 32).int().view(torch.float32), padded & 0xFFFFFFFF


def _order(squared: Tensor, row: Tensor) -> Tensor:
    """Return integers that ascend by (squared distance, row): floats of one sign are ordered as their bits are."""
    return (squared.view(torch.int32).long() << 32) | row


@dataclass(frozen=True)
class _Pairs:
    """Some queries of one cloud with all points of that cloud."""

    query: Tensor  # (m,) int64, rows of the queries
    row: Tensor  # (n,) int64, rows of the points
    squared: Tensor  # (m, n) float32


def pair_chunks(points: Tensor, ptr: Tensor, queries: Tensor, queries_ptr: Tensor) -> Iterator[_Pairs]:
    """Yield all pairs of a query and a point of the same cloud; each query is in one chunk."""
    for (start, stop), (first, last) in zip(pairwise(bounds_of(ptr)), pairwise(bounds_of(queries_ptr)), strict=True):
        row = torch.arange(start, stop, dtype=torch.int64, device=points.device)
        some = max(1, at_once(points.device, _PAIRS) // max(1, stop - start))
        for query in torch.arange(first, last, dtype=torch.int64, device=points.device).split(some):
            if len(query):
                yield _Pairs(query, row, _all_squared(queries[query], points[start:stop]))


def _all_squared(queries: Tensor, points: Tensor) -> Tensor:
    """Return the (m, n) squared distances of all pairs, column by column: never (m, n, D) numbers at once."""
    total = torch.zeros((len(queries), len(points)), dtype=queries.dtype, device=queries.device)
    for a, b in zip(queries.unbind(1), points.unbind(1)):
        offset = a[:, None] - b
        total += offset.mul_(offset)
    return total


def squared_distance(a: Tensor, b: Tensor) -> Tensor:
    """Return the squared distance between (..., D) points of two tensors that broadcast."""
    return sum_of_squares(a - b)


def sum_of_squares(offset: Tensor) -> Tensor:
    """Return ((x*x)+(y*y))+(z*z) of (..., 3) offsets, and so on: separate operations in this order on all backends."""
    total, *others = (offset * offset).unbind(-1)
    for square in others:
        total = total + square
    return total
