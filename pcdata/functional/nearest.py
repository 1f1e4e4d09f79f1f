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

from pcdata.functional.boxtree import LEAF_SIZE, BoxTree, Leaves, box_gap, spatial_order
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
    tree = BoxTree.build(points, ptr, max_copies=k)
    if queries is None and tree.complete:
        leaves, nearest_leaf = tree.leaves, torch.arange(len(tree.leaves), device=points.device)
    else:
        queries, queries_ptr = (points, ptr) if queries is None or queries_ptr is None else (queries, queries_ptr)
        queries = queries.detach()
        leaves = Leaves.of(queries, queries_ptr, spatial_order(queries, queries_ptr))
        nearest_leaf = _descend(tree, leaves)
    search = _Search(tree, leaves, nearest_leaf, k, largest_squared(radius, points.device))
    yield from search.run()


def largest_squared(radius: float | None, device: torch.device) -> Tensor:
    """Return the largest float32 d2 that counts as d < radius; a finite maximum when there is no radius."""
    if radius is None:
        return torch.tensor(torch.finfo(torch.float32).max, device=device)
    limit = torch.tensor(radius, dtype=torch.float32, device=device)
    return torch.nextafter(limit * limit, torch.zeros_like(limit))


def _descend(tree: BoxTree, leaves: Leaves) -> Tensor:
    """Return for each group of queries one leaf near its centre (greedy descent), -1 where its cloud has no points."""
    centre = (leaves.level.low + leaves.level.high) * 0.5
    node, alive = _roots(tree, leaves)
    node = node.clamp(min=0)
    if len(tree.leaves) == 0:
        return torch.full_like(node, -1)
    for depth in range(len(tree.levels) - 1, 0, -1):
        level, below = tree.levels[depth], tree.levels[depth - 1]
        slots, real = level.groups.table()
        children, is_child = slots[node], real[node]
        low, high = below.low[children], below.high[children]
        gap = box_gap(centre[:, None], centre[:, None], low, high)
        # Boxes overlap: among those that hold the centre, the one centred nearest is the likeliest to be dense there.
        offset = (low + high) * 0.5 - centre[:, None]
        score = torch.where(is_child, gap * 1e3 + (offset * offset).sum(-1), torch.inf)
        node = children.gather(1, score.argmin(1, keepdim=True)).squeeze(1)
    return torch.where(alive, node, -1)


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
    nearest_leaf: Tensor  # (G,) a leaf of points near each group, -1 for none
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
        """Return (g, 16): each query's k-th squared distance among the leaves around its group, inf below k points."""
        leaf = self.nearest_leaf[groups]
        ptr = self.tree.leaf_ptr
        cloud = torch.searchsorted(ptr, leaf, right=True) - 1
        begin, end = ptr[cloud.clamp(min=0)], ptr[(cloud + 1).clamp(min=0)]
        first = torch.maximum(torch.minimum(leaf - window // 2, end - window), begin)
        around = first[:, None] + torch.arange(window, device=leaf.device)
        around = torch.where((around < end[:, None]) & (leaf[:, None] >= 0), around, len(self.tree.leaves))
        squared = self._squared(self.leaves.points[groups], around[:, None, :])
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
                group, node = _expand(level.groups.first[node], level.groups.count[node], group)
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


def _expand(first: Tensor, count: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
    """Replace each (owner, node) pair by one pair per child of the node."""
    total = torch.cumsum(count, 0)
    parent = torch.repeat_interleave(torch.arange(len(first), device=first.device), count)
    rank = torch.arange(len(parent), device=first.device) - (total - count)[parent]
    return owner[parent], first[parent] + rank


def _widths(largest: int) -> list[int]:
    """Table widths that cover 1 to ``largest``, growing by a third to a half, so padding stays small."""
    widths = [1, 2, 3, 4]
    while widths[-1] < largest:
        widths.append(widths[-2] * 2)
    return widths
