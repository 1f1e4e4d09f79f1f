"""Exact k nearest neighbors by a walk down the box tree, in chunks of bounded memory.

Queries are grouped like the points, 16 at a time. Each group takes a first bound from the leaves around it, walks the
tree level by level with it, keeps per query the leaves within that query's own bound, and sorts only those points.
Nothing is approximate: a box is dropped only when all of it is farther than k points already seen.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pcdata.contracts.dispatch import INNER, kernel
from pcdata.contracts.on_host import bounds_of, counts_of, read_together, uploaded
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.nearest import Neighbors
from pcdata.functional.neighbor_rows import Listed, cut_to_radii, grown_within, laid_out, widest
from pcdata.functional.radius import largest_squared
from pcdata.functional.rows import cloud_of_rows, group_count, rows_of_mask
from pcdata.kernels.torch_tree.boxtree import LEAF_SIZE, BoxTree, Leaves, box_gap, expand_ranges, spatial_order
from pcdata.threads import at_once

_GROUPS_PER_CHUNK = 512
# Widths of tables, growing by a third to a half, so that padding stays small.
_WIDTHS = [1, *(width for power in range(1, 32) for width in (1 << power, 3 << (power - 1)))]
_MAX_PAIRS = 1 << 16  # (query, point) or (group, box) pairs alive at once: temporaries that stay in cache


@kernel("nearest_chunks", "torch_tree")
def nearest_chunks(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor,  # (B+1,)
    k: int,
    *,
    queries: Tensor | None = None,  # (Q, 3) float32; None = the points
    queries_ptr: Tensor | None = None,  # (B+1,)
    radius: float | None = None,
) -> Iterator[Neighbors]:
    """Search the tree of the points with groups of queries; the tree knows three coordinates."""
    points = points.detach()
    if points.shape[1] != 3:
        yield from INNER["nearest_chunks"].reference(
            points, ptr, k, queries=queries, queries_ptr=queries_ptr, radius=radius
        )
        return
    foreign = queries is not None
    leaves: Leaves | None = None
    if queries is None or queries_ptr is None:
        queries, queries_ptr = points, ptr
        order = spatial_order(points, cloud_of_rows(ptr), len(ptr) - 1)
        tree = BoxTree.build(points, ptr, order, max_copies=k)
        if bounds_of(tree.ptr) == bounds_of(ptr):  # all are kept: the queries are the leaves themselves
            leaves, home = (
                tree.leaves,
                torch.arange(len(tree.leaves), dtype=torch.int64, device=ptr.device)[:, None].expand(-1, LEAF_SIZE),
            )
    if leaves is None:
        tree, leaves, home = _build_together(points, ptr, queries.detach(), queries_ptr, max_copies=k)
    yield from _Search(tree, leaves, home, foreign, k, largest_squared(radius, points.device)).run()


@kernel("nearest_rows", "torch_tree")
def nearest_rows(
    points: Tensor,
    ptr: Tensor,
    k: int,
    *,
    queries: Tensor | None = None,
    queries_ptr: Tensor | None = None,
    radius: float | Tensor | None = None,
    grid: ImageGrid | None = None,
) -> tuple[Tensor, Tensor]:
    """Lay out what the tree finds within the largest radius; a grid of pixels would tell it nothing."""
    chunks = nearest_chunks(points, ptr, k, queries=queries, queries_ptr=queries_ptr, radius=widest(radius))
    found = laid_out(chunks, len(points if queries is None else queries), k, points.device)
    return cut_to_radii(found, points, queries, radius) if isinstance(radius, Tensor) else found


@kernel("rows_within", "torch_tree")
def rows_within(
    points: Tensor,
    ptr: Tensor,
    radius: float | Tensor,
    *,
    queries: Tensor | None = None,
    queries_ptr: Tensor | None = None,
    exclude_self: bool = False,
    grid: ImageGrid | None = None,
) -> Listed:
    """Ask the tree for more and more of the nearest."""
    search = functools.partial(nearest_rows, points, ptr, grid=grid)
    return grown_within(search, points, ptr, radius, queries, queries_ptr, exclude_self)


def _build_together(
    points: Tensor, ptr: Tensor, queries: Tensor, queries_ptr: Tensor, *, max_copies: int
) -> tuple[BoxTree, Leaves, Tensor]:
    """Sort points and queries along one curve; return the tree, the grouped queries and the leaf each query falls in.

    The leaf is (G, 16), -1 where the cloud has no points.
    """
    cloud = torch.cat([cloud_of_rows(ptr), cloud_of_rows(queries_ptr)])
    order = spatial_order(torch.cat([points, queries]), cloud, len(ptr) - 1)
    is_point = order < len(points)
    of_points, of_queries = rows_of_mask(is_point, len(points)), rows_of_mask(~is_point, len(queries))
    tree = BoxTree.build(points, ptr, order[of_points], max_copies=max_copies)
    leaves = Leaves.of(queries, queries_ptr, order[of_queries] - len(points))
    seen = torch.zeros_like(order)
    seen[of_points] = tree.kept.long()
    place = torch.cumsum(seen, 0)[of_queries] - 1  # the last point before each query on the curve
    cloud = cloud_of_rows(queries_ptr)
    first, end = tree.ptr[cloud], tree.ptr[cloud + 1]
    home = tree.leaf_ptr[cloud] + torch.minimum(place.clamp(min=0), end - 1).sub_(first).clamp_(min=0) // LEAF_SIZE
    home = torch.where(first < end, home, -1)
    return tree, leaves, home[leaves.level.groups.table()[0]]


@dataclass(frozen=True)
class _Search:
    tree: BoxTree
    leaves: Leaves  # the queries, grouped
    home: Tensor  # (G, 16) a leaf of points near each query, -1 for none
    foreign: bool  # queries may lie far from all points
    k: int
    limit: Tensor  # () float32, neighbors have d2 <= limit

    @cached_property
    def cloud(self) -> Tensor:
        """(G,) int64: the cloud of every group of queries."""
        return cloud_of_rows(self.leaves.level.groups.ptr)

    def run(self) -> Iterator[Neighbors]:
        window = self._window_size()
        groups, pairs = at_once(self.home.device, _GROUPS_PER_CHUNK), at_once(self.home.device, _MAX_PAIRS)
        per_chunk = max(1, min(groups, pairs // (LEAF_SIZE * LEAF_SIZE * window)))
        for begin in range(0, len(self.leaves), per_chunk):
            some = torch.arange(
                begin, min(begin + per_chunk, len(self.leaves)), dtype=torch.int64, device=self.home.device
            )
            yield from self._walk(some, torch.minimum(self._first_bound(some, window), self.limit))

    def _window_size(self) -> int:
        """Leaves that surely hold k points wherever the cloud has them: only a cloud's last leaf may be short."""
        return max(3, -(-self.k // LEAF_SIZE) + 2)

    def _first_bound(self, groups: Tensor, window: int) -> Tensor:
        """Return (g, 16): each query's k-th squared distance among the leaves around its own, inf below k points."""
        points = self.leaves.points[groups]
        cloud = self.cloud[groups, None]
        bound = self._bound_around(points, self.home[groups], cloud, window)
        if self.foreign:
            bound = torch.minimum(bound, self._bound_around(points, self._descend(points, cloud), cloud, window))
        return bound

    def _descend(self, points: Tensor, cloud: Tensor) -> Tensor:
        """Return (g, 16): the leaf that each query reaches by always taking the nearest box; -1 for an empty cloud.

        For a query far from all points the curve is no guide, and a loose bound would let in every leaf.
        """
        root_ptr = self.tree.levels[-1].groups.ptr
        empty = (root_ptr[cloud + 1] == root_ptr[cloud]).expand(points.shape[:2])
        if len(self.tree.leaves) == 0:
            return torch.full_like(empty, -1, dtype=torch.int64)
        node = root_ptr[cloud].clamp(max=len(self.tree.levels[-1].low) - 1).expand(points.shape[:2])
        for depth in range(len(self.tree.levels) - 1, 0, -1):
            groups, below = self.tree.levels[depth].groups, self.tree.levels[depth - 1]
            slot = torch.arange(groups.size, dtype=torch.int64, device=node.device)
            children = groups.first[node][..., None] + torch.minimum(slot, groups.count[node][..., None] - 1)
            gap = box_gap(points[:, :, None], points[:, :, None], below.low[children], below.high[children])
            node = children.gather(-1, gap.argmin(-1, keepdim=True)).squeeze(-1)
        return torch.where(empty, -1, node)

    def _bound_around(self, points: Tensor, home: Tensor, cloud: Tensor, window: int) -> Tensor:
        """Return (g, 16): the k-th squared distance among ``window`` leaves around ``home``."""
        ptr = self.tree.leaf_ptr
        begin, end = ptr[cloud], ptr[cloud + 1]
        first = torch.maximum(torch.minimum(home - window // 2, end - window), begin)
        around = first[..., None] + torch.arange(window, dtype=torch.int64, device=home.device)
        around = torch.where(around < end[..., None], around, len(self.tree.leaves))
        squared = self._squared(points, around)
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

    def _walk(self, groups: Tensor, bound: Tensor) -> Iterator[Neighbors]:
        """Descend all levels at once with (group, node) pairs, from each group's root; ``bound`` is (g, 16)."""
        root_ptr = self.tree.levels[-1].groups.ptr
        cloud = self.cloud[groups]
        group = torch.arange(len(groups), dtype=torch.int64, device=groups.device)  # counts within this chunk
        if 0 in counts_of(root_ptr):
            group = (root_ptr[cloud + 1] > root_ptr[cloud]).nonzero().squeeze(1)
        node = root_ptr[cloud[group]]
        group_bound = torch.where(self.leaves.real[groups], bound, -torch.inf).amax(1)
        low, high = self.leaves.level.low[groups], self.leaves.level.high[groups]
        for depth in range(len(self.tree.levels) - 1, -1, -1):
            level = self.tree.levels[depth]
            near = box_gap(low[group], high[group], level.low[node], level.high[node]) <= group_bound[group]
            if depth:
                children = torch.where(near, level.groups.count[node], 0)
                group, node = expand_ranges(level.groups.first[node], children, group)
            else:
                rows = near.nonzero().squeeze(1)
                group, node = group[rows], node[rows]
            if len(group) > at_once(group.device, _MAX_PAIRS) and len(groups) > 1:
                # A bound too loose for so many groups at once: walk again with half of them, never with more memory.
                half = len(groups) // 2
                yield from self._walk(groups[:half], bound[:half])
                yield from self._walk(groups[half:], bound[half:])
                return
        yield from self._finish(groups, bound, group, node)

    def _finish(self, groups: Tensor, bound: Tensor, group: Tensor, leaf: Tensor) -> Iterator[Neighbors]:
        """Refine (group, leaf) pairs to (query, leaf) pairs and rank the points in them."""
        points = self.leaves.points[groups]
        boxes = self.tree.levels[0]
        gap = box_gap(points[group], points[group], boxes.low[leaf][:, None], boxes.high[leaf][:, None])
        pair, slot = ((gap <= bound[group]) & self.leaves.real[groups][group]).nonzero(as_tuple=True)
        query, by_query = torch.sort(group[pair] * LEAF_SIZE + slot, stable=True)
        leaf = leaf[pair][by_query]
        points, row = points.flatten(0, 1), self.leaves.row[groups].flatten()
        counts = group_count(query, len(row))
        start = torch.cumsum(counts, 0) - counts
        leaf = torch.cat([leaf, leaf.new_full((1,), len(self.tree.leaves))])  # what empty places of a table read
        # Queries by the width of table that holds them; a repeated slot is no query, and comes last.
        widths = uploaded(torch.tensor(_WIDTHS, dtype=torch.int64, device="cpu"), row.device)
        table = torch.where(self.leaves.real[groups].flatten(), torch.searchsorted(widths, counts), len(_WIDTHS))
        (sizes,) = read_together([group_count(table, len(_WIDTHS) + 1)])
        by_width = table.argsort(stable=True).split(sizes)
        for width, chosen in zip(_WIDTHS, by_width):
            if not len(chosen):
                continue
            places = torch.arange(width, dtype=torch.int64, device=row.device)
            per_part = max(1, at_once(row.device, _MAX_PAIRS) // (width * LEAF_SIZE))
            for begin in range(0, len(chosen), per_part):
                part = chosen[begin : begin + per_part]
                place = torch.where(places < counts[part, None], start[part, None] + places, len(leaf) - 1)
                yield self._rank(row[part], points[part], leaf[place])

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
        return row, squared, index
