"""DBSCAN in linear memory: core points of one cell are one cluster, so only cells need joining.

Source: cells as in Gunawan, A faster algorithm for DBSCAN, 2013.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

import pcdata.functional.clusters  # noqa: F401 - the operation must be registered before its kernel
from pcdata.contracts.dispatch import kernel
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.nearest import sum_of_squares
from pcdata.functional.radius import largest_squared
from pcdata.functional.rows import cloud_of_rows, ptr_after_mask, ptr_from_counts
from pcdata.kernels.torch_tree.boxtree import box_gap, expand_ranges
from pcdata.kernels.torch_tree.cells import Cells
from pcdata.kernels.torch_tree.search import nearest_chunks
from pcdata.threads import at_once

_SAMPLES = 4  # points per cell in the quick test; 16 distances join nearly all neighboring cells
_PAIRS_PER_CHUNK = 1 << 15
_ROWS_PER_CHUNK = 1 << 18


@kernel("density_clusters", "torch_tree")
def density_clusters(points: Tensor, ptr: Tensor, eps: float, min_points: int, grid: ImageGrid | None) -> Tensor:
    """Find the core points, join the cells that hold them, number the clusters and label their borders."""
    core = _core_mask(points, ptr, eps, min_points)
    label = torch.full_like(core, -1, dtype=torch.int64)
    core_rows, core_ptr = core.nonzero().squeeze(1), ptr_after_mask(core, ptr)
    if len(core_rows) == 0:
        return label
    cells = Cells.within("dbscan", points[core_rows], core_ptr, eps)
    component = _join(cells, points[core_rows], eps)[cells.cell]
    label[core_rows] = _number(component, core_rows, ptr)
    return _label_borders(label, points, ptr, core, eps, min_points)


def _core_mask(points: Tensor, ptr: Tensor, eps: float, min_points: int) -> Tensor:
    """Return (N,) bool: at least ``min_points`` points within eps; a crowded cell needs no distances."""
    core = Cells.within("dbscan", points, ptr, eps).crowd() >= min_points
    rows = (~core).nonzero().squeeze(1)
    if len(rows):
        queries = {"queries": points[rows], "queries_ptr": ptr_after_mask(~core, ptr)}
        for query, squared, _ in nearest_chunks(points, ptr, min_points, radius=eps, **queries):
            core[rows[query]] = squared.isfinite().all(1)
    return core


def _label_borders(label: Tensor, points: Tensor, ptr: Tensor, core: Tensor, eps: float, min_points: int) -> Tensor:
    """Give points that are not core the lowest label of the core points in reach: they have fewer than min_points."""
    rows = (~core).nonzero().squeeze(1)
    if len(rows) == 0:
        return label
    none = len(label)  # above every label
    offered = torch.cat([torch.where(core, label, none), label.new_full((1,), none)])
    queries = {"queries": points[rows], "queries_ptr": ptr_after_mask(~core, ptr)}
    for query, _, nearest in nearest_chunks(points, ptr, min_points, radius=eps, **queries):
        lowest = offered[nearest].amin(1)
        label[rows[query]] = torch.where(lowest == none, -1, lowest)
    return label


def _number(component: Tensor, rows: Tensor, ptr: Tensor) -> Tensor:
    """Return labels 0, 1, ... per cloud for components of rows, in the order of their lowest row."""
    lowest = torch.full_like(component, ptr[-1].item()).scatter_reduce_(0, component, rows, "amin")
    starts, cluster = torch.unique(lowest[component], return_inverse=True)
    return cluster - torch.searchsorted(starts, ptr[cloud_of_rows(ptr)[rows]])


def _join(cells: Cells, points: Tensor, eps: float) -> Tensor:
    """Return (C,) int64: cells whose points are linked by steps d < eps share a number."""
    limit = largest_squared(eps, points.device)
    order = torch.argsort(cells.cell, stable=True)
    members, start = points[order], ptr_from_counts(cells.count)
    index = cells.cell[order][:, None].expand(-1, 3)
    low = points.new_full((len(cells), 3), torch.inf).scatter_reduce_(0, index, members, "amin")
    high = points.new_full((len(cells), 3), -torch.inf).scatter_reduce_(0, index, members, "amax")
    slot = torch.arange(_SAMPLES, dtype=torch.int64, device=points.device)
    sample = members[start[:-1, None] + cells.count[:, None] * slot // _SAMPLES]  # repeats in a small cell

    parent = torch.arange(len(cells), dtype=torch.int64, device=points.device)
    open_pairs = [parent.new_empty((2, 0))]
    for pairs in cells.neighbor_pairs():
        for a, b in zip(*(side.split(at_once(points.device, _PAIRS_PER_CHUNK)) for side in pairs)):
            apart = parent[a] != parent[b]
            a, b = a[apart], b[apart]
            near = box_gap(low[a], high[a], low[b], high[b]) <= limit
            a, b = a[near], b[near]
            squared = sum_of_squares(sample[a][:, :, None] - sample[b][:, None, :])
            linked = (squared <= limit).flatten(1).any(1)
            parent = _merge(parent, a[linked], b[linked])
            tested_all = (cells.count[a] <= _SAMPLES) & (cells.count[b] <= _SAMPLES)
            open_pairs.append(torch.stack([a, b])[:, ~linked & ~tested_all])
    for a, b in _chunks_by_size(torch.cat(open_pairs, 1), cells.count):
        apart = parent[a] != parent[b]
        a, b = a[apart], b[apart]
        if len(a) == 0:
            continue
        linked = _any_within(members, start, low, high, a, b, eps)
        parent = _merge(parent, a[linked], b[linked])
    return parent


def _any_within(members: Tensor, start: Tensor, low: Tensor, high: Tensor, a: Tensor, b: Tensor, eps: float) -> Tensor:
    """Return (P,) bool: some point of cell a[i] has d < eps to some point of cell b[i]."""
    limit = largest_squared(eps, members.device)
    sides = []
    for mine, other in ((a, b), (b, a)):
        pair, row = expand_ranges(
            start[mine], start[mine + 1] - start[mine], torch.arange(len(a), dtype=torch.int64, device=a.device)
        )
        point = members[row]
        near = box_gap(point, point, low[other[pair]], high[other[pair]]) <= limit
        counts = torch.bincount(pair[near], minlength=len(a))
        sides.append((point[near], ptr_from_counts(counts)))
    linked = torch.zeros(len(a), dtype=torch.bool, device=a.device)
    (queries, queries_ptr), (targets, targets_ptr) = sides
    pair_of_query = cloud_of_rows(queries_ptr)
    # Each pair of cells is one ragged cloud: targets from one cell, queries from the other.
    for query, squared, _ in nearest_chunks(
        targets, targets_ptr, 1, queries=queries, queries_ptr=queries_ptr, radius=eps
    ):
        linked[pair_of_query[query[squared[:, 0].isfinite()]]] = True
    return linked


def _chunks_by_size(pairs: Tensor, count: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield (2, P) pairs of cells in pieces that hold a bounded number of points."""
    chunk = torch.cumsum(count[pairs[0]] + count[pairs[1]], 0) // at_once(pairs.device, _ROWS_PER_CHUNK)
    for piece in pairs.split_with_sizes(torch.unique_consecutive(chunk, return_counts=True)[1].tolist(), dim=1):
        yield piece[0], piece[1]


def _merge(parent: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Join the components of a[i] and b[i]; ``parent`` (C,) names each one by its lowest member, before and after.

    Source: hooking and pointer jumping, Shiloach & Vishkin, An O(log n) parallel connectivity algorithm, 1982.
    """
    while True:
        one, two = parent[a], parent[b]
        apart = one != two
        if not bool(apart.any()):
            return parent
        a, b, one, two = a[apart], b[apart], one[apart], two[apart]
        parent = parent.scatter_reduce(0, torch.maximum(one, two), torch.minimum(one, two), "amin")
        while not torch.equal(jumped := parent[parent], parent):
            parent = jumped
