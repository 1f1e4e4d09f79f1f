"""Exact k nearest neighbours by a walk down the box tree, in chunks of bounded memory.

Queries are grouped like the points, 16 at a time. Each group takes a first bound from the leaves around it, walks the
tree level by level with it, keeps per query the leaves within that query's own bound, and sorts only those points.
Nothing is approximate: a box is dropped only when all of it is farther than k points already seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.functional.boxtree import LEAF_SIZE, BoxTree, Leaves, box_gap, expand_ranges, spatial_order
from pcdata.functional.ragged import cloud_of_rows

_GROUPS_PER_CHUNK = 512
_MAX_PAIRS = 1 << 16  # (query, point) or (group, box) pairs alive at once: temporaries that stay in cache


@dataclass(frozen=True)
class Neighbors:
    """The neighbours of some queries, ascending by (squared distance, row); padding is (inf, N)."""

    query: Tensor  # (m,) int64, row of the caller's queries
    squared: Tensor  # (m, k) float32
    index: Tensor  # (m, k) int64, rows of the caller's points

    @property
    def found(self) -> Tensor:
        """(m, k) bool: a real neighbour, not padding."""
        return torch.isfinite(self.squared)


def nearest_chunks(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor,  # (B+1,)
    k: int,
    *,
    queries: Tensor | None = None,  # (Q, 3) float32; None = the points
    queries_ptr: Tensor | None = None,  # (B+1,)
    radius: float | None = None,
) -> Iterator[Neighbors]:
    """Yield every query's k nearest points of its own cloud (with d < radius), each query once, in no fixed order.

    A query that is one of the points counts itself. The radius test is ``d2 < float32(radius) * float32(radius)``.
    """
    points = points.detach()
    leaves: Leaves | None = None
    if queries is None or queries_ptr is None:
        queries, queries_ptr = points, ptr
        tree = BoxTree.build(points, ptr, spatial_order(points, cloud_of_rows(ptr)), max_copies=k)
        if bool(tree.kept.all()):  # the queries are the leaves themselves
            leaves, home = tree.leaves, torch.arange(len(tree.leaves), device=ptr.device)[:, None].expand(-1, LEAF_SIZE)
    if leaves is None:
        tree, leaves, home = _build_together(points, ptr, queries.detach(), queries_ptr, max_copies=k)
    yield from _Search(tree, leaves, home, k, largest_squared(radius, points.device)).run()


def largest_squared(radius: float | None, device: torch.device) -> Tensor:
    """Return the largest float32 d2 that counts as d < radius; a finite maximum when there is no radius."""
    if radius is None:
        return torch.tensor(torch.finfo(torch.float32).max, device=device)
    limit = torch.tensor(radius, dtype=torch.float32, device=device)
    return torch.nextafter(limit * limit, torch.zeros_like(limit))


def _build_together(
    points: Tensor, ptr: Tensor, queries: Tensor, queries_ptr: Tensor, *, max_copies: int
) -> tuple[BoxTree, Leaves, Tensor]:
    """Sort points and queries along one curve; return the tree, the grouped queries and the leaf each query falls in.

    The leaf is (G, 16), -1 where the cloud has no points.
    """
    cloud = torch.cat([cloud_of_rows(ptr), cloud_of_rows(queries_ptr)])
    order = spatial_order(torch.cat([points, queries]), cloud)
    is_point = order < len(points)
    tree = BoxTree.build(points, ptr, order[is_point], max_copies=max_copies)
    leaves = Leaves.of(queries, queries_ptr, order[~is_point] - len(points))
    seen = torch.zeros_like(order)
    seen[is_point] = tree.kept.long()
    place = torch.cumsum(seen, 0)[~is_point] - 1  # the last point before each query on the curve
    cloud = cloud_of_rows(queries_ptr)
    first, end = tree.ptr[cloud], tree.ptr[cloud + 1]
    home = tree.leaf_ptr[cloud] + torch.minimum(place.clamp(min=0), end - 1).sub_(first).clamp_(min=0) // LEAF_SIZE
    home = torch.where(first < end, home, -1)
    return tree, leaves, home[leaves.level.groups.table()[0]]


def _roots(tree: BoxTree, leaves: Leaves) -> tuple[Tensor, Tensor]:
    """Return each query group's root node and whether its cloud has one."""
    root_ptr = tree.levels[-1].groups.ptr
    cloud = cloud_of_rows(leaves.level.groups.ptr)
    alive = root_ptr[cloud + 1] > root_ptr[cloud]
    return torch.where(alive, root_ptr[cloud], -1), alive


@dataclass(frozen=True)
class _Search:
    tree: BoxTree
    leaves: Leaves  # the queries, grouped
    home: Tensor  # (G, 16) a leaf of points near each query, -1 for none
    k: int
    limit: Tensor  # () float32, neighbours have d2 <= limit

    def run(self) -> Iterator[Neighbors]:
        window = self._window_size()
        per_chunk = max(1, min(_GROUPS_PER_CHUNK, _MAX_PAIRS // (LEAF_SIZE * LEAF_SIZE * window)))
        roots, alive = _roots(self.tree, self.leaves)
        for groups in torch.arange(len(self.leaves), device=roots.device).split(per_chunk):
            bound = self._first_bound(groups, window)
            has_root = alive[groups]
            yield from self._walk(groups, bound, has_root.nonzero().squeeze(1), roots[groups[has_root]])

    def _window_size(self) -> int:
        """Leaves that surely hold k points wherever the cloud has them: only a cloud's last leaf may be short."""
        return max(3, -(-self.k // LEAF_SIZE) + 2)

    def _first_bound(self, groups: Tensor, window: int) -> Tensor:
        """Return (g, 16): each query's k-th squared distance among the leaves around its own, inf below k points."""
        home = self.home[groups]
        ptr = self.tree.leaf_ptr
        cloud = cloud_of_rows(self.leaves.level.groups.ptr)[groups, None]
        begin, end = ptr[cloud], ptr[cloud + 1]
        first = torch.maximum(torch.minimum(home - window // 2, end - window), begin)
        around = first[..., None] + torch.arange(window, device=home.device)
        around = torch.where(around < end[..., None], around, len(self.tree.leaves))
        squared = self._squared(self.leaves.points[groups], around)
        if self.k > squared.shape[-1]:
            return torch.full_like(squared[..., 0], torch.inf)
        return squared.topk(self.k, largest=False, sorted=False).values.amax(-1)

    def _squared(self, queries: Tensor, leaf: Tensor) -> Tensor:
        """Return (..., w*16) squared distances from (..., 3) queries to the points of their (..., w) leaves."""
        total: Tensor | None = None
        for axis in range(3):
            offset = self.tree.coordinates[axis][leaf].flatten(-2) - queries[..., axis, None]
            offset *= offset
            total = offset if total is None else total.add_(offset)
        assert total is not None
        return total

    def _walk(self, groups: Tensor, bound: Tensor, group: Tensor, node: Tensor) -> Iterator[Neighbors]:
        """Descend from (group, node) pairs to leaves; ``group`` counts within ``groups``."""
        bound = torch.minimum(bound, self.limit)
        group_bound = torch.where(self.leaves.real[groups], bound, -torch.inf).amax(1)
        low, high = self.leaves.level.low[groups], self.leaves.level.high[groups]
        for depth in range(len(self.tree.levels) - 1, -1, -1):
            level = self.tree.levels[depth]
            near = box_gap(low[group], high[group], level.low[node], level.high[node]) <= group_bound[group]
            group, node = group[near], node[near]
            if depth:
                group, node = expand_ranges(level.groups.first[node], level.groups.count[node], group)
            if len(group) > _MAX_PAIRS and len(groups) > 1:
                # A bound too loose for so many groups at once: walk again with half of them, never with more memory.
                half = len(groups) // 2
                for part in (slice(0, half), slice(half, None)):
                    chosen = groups[part]
                    roots, alive = _roots(self.tree, self.leaves)
                    inside = alive[chosen]
                    yield from self._walk(chosen, bound[part], inside.nonzero().squeeze(1), roots[chosen[inside]])
                return
        yield from self._finish(groups, bound, group, node)

    def _finish(self, groups: Tensor, bound: Tensor, group: Tensor, leaf: Tensor) -> Iterator[Neighbors]:
        """Refine (group, leaf) pairs to (query, leaf) pairs and rank the points in them."""
        points = self.leaves.points[groups]
        boxes = self.tree.levels[0]
        by_group = torch.argsort(group, stable=True)
        group, leaf = group[by_group], leaf[by_group]
        gap = box_gap(points[group], points[group], boxes.low[leaf][:, None], boxes.high[leaf][:, None])
        pair, slot = ((gap <= bound[group]) & self.leaves.real[groups][group]).nonzero(as_tuple=True)
        query, leaf, gap = group[pair] * LEAF_SIZE + slot, leaf[pair], gap[pair, slot]
        by_query = torch.argsort(query, stable=True)
        query, leaf, gap = query[by_query], leaf[by_query], gap[by_query]
        points, bound, row = points.flatten(0, 1), bound.flatten(), self.leaves.row[groups].flatten()
        counts = torch.bincount(query, minlength=len(row))
        counts = torch.where(self.leaves.real[groups].flatten(), counts, -1)
        start = torch.cumsum(counts.clamp(min=0), 0) - counts.clamp(min=0)
        width = 0
        for next_width in _widths(int(counts.max()) if len(counts) else 0):
            chosen = ((counts > width) & (counts <= next_width)).nonzero().squeeze(1)
            if width == 0:
                chosen = torch.cat([chosen, (counts == 0).nonzero().squeeze(1)])
            width = next_width
            for part in chosen.split(max(1, _MAX_PAIRS // (width * LEAF_SIZE))):
                slots = torch.arange(width, device=part.device)
                real = slots < counts[part, None]
                place = (start[part, None] + slots).clamp(max=max(len(leaf) - 1, 0))
                if len(leaf):
                    candidates = torch.where(real, leaf[place], len(self.tree.leaves))
                else:
                    candidates = torch.full_like(place, len(self.tree.leaves))
                yield self._rank(row[part], points[part], candidates)

    def _rank(self, row: Tensor, points: Tensor, candidates: Tensor) -> Neighbors:
        """Sort the points of the (m, w) candidate leaves by (d2, row) and keep k."""
        squared = self._squared(points, candidates)
        index = self.tree.row[candidates].flatten(-2)
        # Non-negative floats sort like their bits: one integer holds the total order.
        key = (squared.view(torch.int32).long() << 32) | index
        k = min(self.k, key.shape[1])
        key = key.topk(k, largest=False).values
        squared, index = (key >> 32).int().view(torch.float32), key & 0xFFFFFFFF
        outside = squared > self.limit
        squared, index = squared.masked_fill(outside, torch.inf), index.masked_fill(outside, self.tree.num_points)
        if k < self.k:
            squared = torch.nn.functional.pad(squared, (0, self.k - k), value=torch.inf)
            index = torch.nn.functional.pad(index, (0, self.k - k), value=self.tree.num_points)
        return Neighbors(row, squared, index)


def _widths(largest: int) -> list[int]:
    """Table widths that cover 1 to ``largest``, growing by a third to a half, so padding stays small."""
    widths = [1, 2, 3, 4]
    while widths[-1] < largest:
        widths.append(widths[-2] * 2)
    return widths
