"""Neighbors by other distances than the straight one: sums of the coordinates' differences, or the largest of them.

The core has trees for them. Other backends search straight: a ball of such a distance lies within a straight ball, so
all that could be a neighbor is found, measured and sorted again. All answers are those of looking at every pair.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

from pcdata.contracts.dispatch import REFERENCE, inner
from pcdata.contracts.on_host import bounds_of
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts
from pcdata.threads import at_once

NORMS = ("l2", "l1", "linf")

# What finds the straight nearest rows, and all rows within a radius.
Searches = tuple[Callable[..., tuple[Tensor, Tensor]], Callable[..., tuple[Tensor, Tensor, Tensor]]]

_PAIRS = 1 << 20  # looked at together
_QUERIES = 1 << 15  # whose candidates are listed together
_LOOKED_AT = 16  # straight nearest at least: the bound of a few more saves most candidates where clouds lie apart
# Of straight distances, by which float32 sums of up to 4 columns err by far less.
_MARGIN = 1 + 1e-5
# Columns up to which straight balls hold few points more: of 4 the ball around a cube has 5 times its volume.
_MOST_COLUMNS = 4
_LEAST_RADIUS = 1e-18  # whose square is positive in float32


def norm_length(offset: Tensor, norm: str) -> Tensor:
    """Return (|x|+|y|)+|z| of (..., D) offsets, and so on; or the largest of |x|, |y|, |z|."""
    first, *others = offset.abs().unbind(-1)
    for other in others:
        first = first + other if norm == "l1" else torch.maximum(first, other)
    return first


def nearest_in_norm(
    points: Tensor,  # (N, D) float32
    ptr: Tensor,
    norm: str,
    searches: Searches,
    k: int,
    *,
    queries: Tensor | None = None,
    queries_ptr: Tensor | None = None,
    radius: float | Tensor | None = None,
    backend: str = REFERENCE,
) -> tuple[Tensor, Tensor]:  # index (Q, k) int64, distance (Q, k) float32
    """Find the k nearest points of its own cloud (with d < radius) for every query; padding is (N, infinity)."""
    if queries is None or queries_ptr is None:
        queries, queries_ptr = points, ptr
    limit = _limits(math.inf if radius is None else radius, queries)
    asked = points, ptr, norm, k, queries, queries_ptr, limit
    if backend in (REFERENCE, "cpu") or points.shape[1] > _MOST_COLUMNS:
        return nearest_by_norm(*asked, backend=backend)
    return _of_candidates(points, ptr, norm, searches, k, queries, queries_ptr, limit, backend)


@inner
def nearest_by_norm(
    points: Tensor,
    ptr: Tensor,
    norm: str,
    k: int,
    queries: Tensor,
    queries_ptr: Tensor,
    limit: Tensor,  # (Q,) float32: neighbors have d < limit
    *,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """Look at every pair; rows of equal distance ascend."""
    index = torch.full((len(queries), k), len(points), dtype=torch.int64, device=points.device)
    distance = torch.full((len(queries), k), torch.inf, dtype=torch.float32, device=points.device)
    for (start, stop), (first, last) in zip(pairwise(bounds_of(ptr)), pairwise(bounds_of(queries_ptr)), strict=True):
        if start == stop:
            continue
        row = torch.arange(start, stop, dtype=torch.int64, device=points.device)
        for query in torch.arange(first, last, dtype=torch.int64, device=points.device).split(
            max(1, at_once(points.device, _PAIRS) // (stop - start))
        ):
            apart = norm_length(queries[query][:, None] - points[start:stop], norm)
            key = _order(torch.where(apart < limit[query][:, None], apart, torch.inf), row)
            nearest = key.topk(min(k, stop - start), largest=False).values
            apart = (nearest >> 32).int().view(torch.float32)
            index[query, : nearest.shape[1]] = torch.where(apart < torch.inf, nearest & 0xFFFFFFFF, len(points))
            distance[query, : nearest.shape[1]] = apart
    return index, distance


def _order(distance: Tensor, row: Tensor) -> Tensor:
    """Return integers that ascend by (distance, row): floats of one sign are ordered as their bits are."""
    return (distance.contiguous().view(torch.int32).long() << 32) | row


def _of_candidates(
    points: Tensor,
    ptr: Tensor,
    norm: str,
    searches: Searches,
    k: int,
    queries: Tensor,
    queries_ptr: Tensor,
    limit: Tensor,
    backend: str,
) -> tuple[Tensor, Tensor]:
    nearest_rows, rows_within = searches
    own = {"queries": queries, "queries_ptr": queries_ptr}
    wider = _MARGIN * (1.0 if norm == "l1" else math.sqrt(points.shape[1]))
    largest = float(limit.max()) if len(limit) else torch.inf
    looked_at, radius = max(k, _LOOKED_AT), wider * largest if largest < 1e19 else None
    straight, _ = nearest_rows(points, ptr, looked_at, **own, radius=radius, backend=backend)
    index, distance = _measured(points, norm, queries, straight)
    index, distance = index[:, :k].contiguous(), distance[:, :k].contiguous()
    # The straight nearest bound the distance within which all k lie; where there are fewer, these are all, and where
    # the last of them is beyond that bound, no other is within it.
    last = straight[:, -1]
    is_full = last < len(points)
    beyond = torch.full((len(queries),), torch.inf, dtype=torch.float64, device=points.device)
    beyond[is_full] = (queries[is_full].double() - points[last[is_full]].double()).square().sum(1).sqrt()
    bound = torch.minimum(distance[:, -1], limit).double() * wider
    for some in (distance[:, -1].isfinite() & (beyond < bound)).nonzero().squeeze(1).split(_QUERIES):
        bounds = torch.searchsorted(some, queries_ptr.contiguous())
        reach = (torch.minimum(distance[some, -1], limit[some]) * wider).clamp(min=_LEAST_RADIUS, max=1e19)
        row, _, found_ptr = rows_within(points, ptr, reach, queries=queries[some], queries_ptr=bounds, backend=backend)
        query = cloud_of_rows(found_ptr)
        apart = norm_length(queries[some][query] - points[row], norm)
        order = _order(apart, row).argsort()
        order = order[query[order].argsort(stable=True)]
        place = torch.arange(len(row), dtype=torch.int64, device=points.device) - found_ptr[query]
        kept = place < k
        index[some], distance[some] = len(points), torch.inf
        index[some[query[kept]], place[kept]] = row[order][kept]
        distance[some[query[kept]], place[kept]] = apart[order][kept]
    outside = distance >= limit[:, None]
    return index.masked_fill(outside, len(points)), distance.masked_fill(outside, torch.inf)


def _measured(points: Tensor, norm: str, queries: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Return found neighbors (Q, k) in the order of a norm, and their distances."""
    found = index < len(points)
    if not len(points):
        return index, torch.full(index.shape, torch.inf, dtype=torch.float32, device=points.device)
    apart = norm_length(queries[:, None] - points[index.clamp(max=len(points) - 1)], norm)
    key = _order(torch.where(found, apart, torch.inf), index).sort(1).values
    return key & 0xFFFFFFFF, (key >> 32).int().view(torch.float32)


def within_in_norm(
    points: Tensor,
    ptr: Tensor,
    norm: str,
    rows_within: Callable[..., tuple[Tensor, Tensor, Tensor]],
    radius: float | Tensor,
    *,
    queries: Tensor | None = None,
    queries_ptr: Tensor | None = None,
    exclude_self: bool = False,
    backend: str = REFERENCE,
) -> tuple[Tensor, Tensor, Tensor]:
    """Find all points of its own cloud with d < radius for every query, nearest first."""
    own = {} if queries is None else {"queries": queries, "queries_ptr": queries_ptr}
    wider = _MARGIN * (1.0 if norm == "l1" else math.sqrt(points.shape[1]))
    row, _, found_ptr = rows_within(points, ptr, radius * wider, **own, exclude_self=exclude_self, backend=backend)
    asked = points if queries is None else queries
    query = cloud_of_rows(found_ptr)
    apart = norm_length(asked[query] - points[row], norm)
    near = apart < _limits(radius, asked)[query]
    row, query, apart = row[near], query[near], apart[near]
    order = _order(apart, row).argsort()
    order = order[query[order].argsort(stable=True)]
    return row[order], apart[order], ptr_from_counts(torch.bincount(query, minlength=len(asked)))


def _limits(radius: float | Tensor, queries: Tensor) -> Tensor:
    """Return one float32 radius for every query (Q,)."""
    return torch.as_tensor(radius, dtype=torch.float32, device=queries.device).expand(len(queries))
