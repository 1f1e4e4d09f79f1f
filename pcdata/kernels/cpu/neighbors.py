"""Neighbor kernels: the nearest, all within a radius, by an index or without, and distances of clouds.

They search one box tree over Morton order, sixteen queries at a time; clouds with an image grid search pixel windows
first. Points of other than three columns have trees of their own. Results are those of the references: the same
neighbors in the same order.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

import pcdata.functional.neighbor_index  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, OPERATIONS, kernel
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.metrics import mean_per_cloud
from pcdata.functional.neighbor_rows import Listed, cut_to_radii, grown_within, widest
from pcdata.functional.norms import NORMS
from pcdata.functional.rows import ptr_from_counts
from pcdata.kernels.cpu.native import call, room, room_for
from pcdata.kernels.cpu.search_arguments import MAX_ROWS, core_rows, grid_arguments, limit_of, limits_of

# Of equal points an index keeps so many: thousands in one place (zeros of missing depth) would all be looked at.
_COPIES = 128


@kernel("nearest_rows", "cpu")
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
    """Run the reference's contract in the core; a radius per query is cut out of the largest in its wide trees."""
    if points.shape[1] not in (0, 3) and max(k, len(points)) <= MAX_ROWS:
        found = _wide_neighbors(points, ptr, k, limit_of(widest(radius)), queries, queries_ptr)
        return cut_to_radii(found, points, queries, radius) if isinstance(radius, Tensor) else found
    if k > MAX_ROWS or points.shape[1] != 3:
        others = {"queries": queries, "queries_ptr": queries_ptr, "radius": radius, "grid": grid}
        fallen: tuple[Tensor, Tensor] = INNER["nearest_rows"].reference(points, ptr, k, **others)
        return fallen
    return _neighbors(points, ptr, k, radius, queries, queries_ptr, grid)


@kernel("nearest_by_norm", "cpu")
def nearest_by_norm(
    points: Tensor, ptr: Tensor, norm: str, k: int, queries: Tensor, queries_ptr: Tensor, limit: Tensor
) -> tuple[Tensor, Tensor]:
    """Search in the wide trees within the largest limit, then leave out what is beyond each query's own."""
    if not points.shape[1] or max(k, len(points)) > MAX_ROWS:
        fallen: tuple[Tensor, Tensor] = INNER["nearest_by_norm"].reference(
            points, ptr, norm, k, queries, queries_ptr, limit
        )
        return fallen
    most = min(float(limit.max()) if len(limit) else 0.0, float(torch.finfo(torch.float32).max))
    index, distance = _wide_neighbors(points, ptr, k, most, queries, queries_ptr, norm)
    outside = distance >= limit[:, None]
    return index.masked_fill_(outside, len(points)), distance.masked_fill_(outside, torch.inf)


@kernel("rows_within", "cpu")
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
    """Count the neighbors of three columns, then list them; of others ask for more and more of the nearest."""
    if points.shape[1] != 3 or len(points) > MAX_ROWS:
        search = functools.partial(nearest_rows, points, ptr, grid=grid)
        return grown_within(search, points, ptr, radius, queries, queries_ptr, exclude_self)
    return _listed(_tree(points, ptr, MAX_ROWS), radius, queries, queries_ptr, exclude_self)


@kernel("within_in", "cpu")
def within_in(
    points: Tensor,
    ptr: Tensor,
    prepared: dict[str, Tensor],
    radius: float | Tensor,
    *,
    queries: Tensor | None = None,
    queries_ptr: Tensor | None = None,
    exclude_self: bool = False,
) -> Listed:
    """List what is sorted; where equal points were left out, sort anew."""
    if not prepared or int(prepared["kept"]) != len(points):
        return rows_within(points, ptr, radius, queries=queries, queries_ptr=queries_ptr, exclude_self=exclude_self)
    return _listed(prepared, radius, queries, queries_ptr, exclude_self)


def _listed(
    tree: dict[str, Tensor],
    radius: float | Tensor,
    queries: Tensor | None,
    queries_ptr: Tensor | None,
    exclude_self: bool,
) -> Listed:
    """List all neighbors among the points of a tree with all rows kept."""
    groups = tree
    if queries is not None:
        assert queries_ptr is not None
        groups = _tree(queries, queries_ptr, MAX_ROWS)
    radii = radius if isinstance(radius, Tensor) else torch.tensor([radius], dtype=torch.float32, device="cpu")
    arguments = (
        *(tree["leaves"], tree["leaf_ptr"], len(tree["leaf_ptr"]) - 1, tree["boxes"]),
        *(groups["leaves"], groups["leaf_ptr"], radii.contiguous(), int(isinstance(radius, Tensor)), int(exclude_self)),
    )
    counts = room(int(groups["kept"]), torch.int64)
    call("pc_count_within", *arguments, counts)
    neighbors_ptr = ptr_from_counts(counts)
    size = int(neighbors_ptr[-1])
    index, distance = room_for(((size,), torch.int64), ((size,), torch.float32))
    call("pc_list_within", *arguments, neighbors_ptr, index, distance)
    return index, distance, neighbors_ptr


@kernel("sorted_rows", "cpu")
def sorted_rows(points: Tensor, ptr: Tensor) -> dict[str, Tensor]:
    """Sort points of three columns into leaves with boxes over them, as the search builds them for one call."""
    if points.shape[1] != 3 or len(points) > MAX_ROWS:
        return {}
    return _tree(points, ptr, _COPIES)


def _tree(points: Tensor, ptr: Tensor, copies: int) -> dict[str, Tensor]:
    """Return the leaves and boxes of points, of equal ones so many."""
    points, ptr = core_rows(points, ptr)
    leaves, boxes = 0, 0
    for count in torch.diff(ptr).tolist():
        nodes = -(-count // 16)
        leaves += nodes
        while nodes:
            nodes = -(-nodes // 16)
            boxes += nodes
            nodes = nodes if nodes > 1 else 0
    made = {
        "leaves": room((leaves, 64), torch.float32),
        "leaf_ptr": room(len(ptr), torch.int64),
        "boxes": room((boxes, 96), torch.float32),
        "kept": room(1, torch.int64),
    }
    call("pc_index_points", points, ptr, len(ptr) - 1, copies, *made.values())
    return made


@kernel("nearest_in", "cpu")
def nearest_in(
    points: Tensor,
    ptr: Tensor,
    prepared: dict[str, Tensor],
    k: int,
    *,
    queries: Tensor | None = None,
    queries_ptr: Tensor | None = None,
    radius: float | Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Search what is sorted; where equal points were left out that now count, sort anew."""
    is_whole = bool(prepared) and int(prepared["kept"]) == len(points)
    if not prepared or k > (MAX_ROWS if is_whole else _COPIES):
        return nearest_rows(points, ptr, k, queries=queries, queries_ptr=queries_ptr, radius=radius)
    if queries is None and not is_whole:
        queries, queries_ptr = points, ptr
    num_queries = len(points)
    if queries is not None:
        assert queries_ptr is not None
        queries, queries_ptr = core_rows(queries, queries_ptr)
        num_queries = len(queries)
    index, distance = room((num_queries, k), torch.int64), room((num_queries, k), torch.float32)
    tree = prepared["leaves"], prepared["leaf_ptr"], len(ptr) - 1, prepared["boxes"], len(points)
    call("pc_indexed_neighbors", *tree, queries, queries_ptr, k, *limits_of(radius), index, distance)
    return index, distance


@kernel("chamfer_distance", "cpu")
def chamfer_distance(
    *,
    points_a: Tensor,
    ptr_a: Tensor,
    points_b: Tensor,
    ptr_b: Tensor,
    squared: bool,
    sides: str,
    norm: str,
    normals_a: Tensor | None,
    normals_b: Tensor | None,
    abs_cosine: bool,
) -> Tensor:
    """Run the reference's contract in the core, without gradients; it measures distances alone."""
    if norm != "l2" or normals_a is not None or normals_b is not None:
        found: Tensor = OPERATIONS["chamfer_distance"].reference(
            points_a,
            ptr_a,
            points_b,
            ptr_b,
            squared=squared,
            sides=sides,
            norm=norm,
            normals_a=normals_a,
            normals_b=normals_b,
            abs_cosine=abs_cosine,
            backend="cpu",
        )
        return found
    total = torch.zeros(len(ptr_a) - 1, dtype=torch.float64, device="cpu")
    if sides != "b_to_a":
        total = total + _mean_to_nearest(points_a, ptr_a, points_b, ptr_b, squared)
    if sides != "a_to_b":
        total = total + _mean_to_nearest(points_b, ptr_b, points_a, ptr_a, squared)
    return total.float()


def _neighbors(
    points: Tensor,
    ptr: Tensor,
    k: int,
    radius: float | Tensor | None,
    queries: Tensor | None,
    queries_ptr: Tensor | None,
    grid: ImageGrid | None,
) -> tuple[Tensor, Tensor]:
    points, ptr = core_rows(points, ptr)
    num_queries = len(points)
    if queries is not None:
        assert queries_ptr is not None
        queries, queries_ptr = core_rows(queries, queries_ptr)
        num_queries = len(queries)
    index = room((num_queries, k), torch.int64)
    distance = room((num_queries, k), torch.float32)
    call(
        "pc_neighbors",
        *(points, ptr, len(ptr) - 1, queries, queries_ptr, k, *limits_of(radius)),
        *(*grid_arguments(grid), index, distance),
    )
    return index, distance


def _wide_neighbors(
    points: Tensor,
    ptr: Tensor,
    k: int,
    limit: float,
    queries: Tensor | None,
    queries_ptr: Tensor | None,
    norm: str = "l2",
) -> tuple[Tensor, Tensor]:
    """Search in trees of boxes of any number of columns; ``limit`` is of squares of straight distances."""
    points, ptr = core_rows(points, ptr)
    num_queries = len(points)
    if queries is not None:
        assert queries_ptr is not None
        queries, queries_ptr = core_rows(queries, queries_ptr)
        num_queries = len(queries)
    index, distance = room((num_queries, k), torch.int64), room((num_queries, k), torch.float32)
    arrays = points, ptr, len(ptr) - 1, points.shape[1], queries, queries_ptr
    call("pc_wide_neighbors", *arrays, k, limit, NORMS.index(norm), index, distance)
    return index, distance


def _mean_to_nearest(queries: Tensor, queries_ptr: Tensor, points: Tensor, ptr: Tensor, squared: bool) -> Tensor:
    """Return (B,) float64: the mean (squared) distance from every query to the nearest point of its cloud."""
    points, ptr = core_rows(points, ptr)
    queries, queries_ptr = core_rows(queries, queries_ptr)
    distance = room(len(queries), torch.float32)
    call("pc_nearest_squared", points, ptr, len(ptr) - 1, queries, queries_ptr, distance)
    return mean_per_cloud(distance if squared else distance.sqrt_(), queries_ptr)
