"""Neighbor kernels: kNN, ball query, chamfer distance, outliers, normals, DBSCAN.

Radius outliers and DBSCAN count in cells. All others search one box tree over Morton order, sixteen queries at a time;
clouds with an image grid search pixel windows first. Points of other than three columns have trees of their own.
Results are those of the references: the same neighbors in the same order, the same masks.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

# The operations must be registered before their kernels.
import pcdata.functional.clusters
import pcdata.functional.neighbor_index
import pcdata.functional.neighborhoods
import pcdata.functional.normals
import pcdata.functional.outliers  # noqa: F401
from pcdata.contracts.dispatch import INNER, OPERATIONS, kernel
from pcdata.functional.image_grid import ImageGrid, checked_grid
from pcdata.functional.metrics import mean_per_cloud
from pcdata.functional.neighbors import Listed, cut_to_radii, grown_within, widest
from pcdata.functional.norms import NORMS
from pcdata.functional.radius import largest_squared, require_cells
from pcdata.functional.rows import ptr_from_counts
from pcdata.kernels.cpu.native import call, room, room_for

# The core keeps rows, and numbers of neighbors, in 31 bits.
_MAX_ROWS = 2**31 - 1

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
    if points.shape[1] not in (0, 3) and max(k, len(points)) <= _MAX_ROWS:
        found = _wide_neighbors(points, ptr, k, _limit(widest(radius)), queries, queries_ptr)
        return cut_to_radii(found, points, queries, radius) if isinstance(radius, Tensor) else found
    if k > _MAX_ROWS or points.shape[1] != 3:
        others = {"queries": queries, "queries_ptr": queries_ptr, "radius": radius, "grid": grid}
        fallen: tuple[Tensor, Tensor] = INNER["nearest_rows"].reference(points, ptr, k, **others)
        return fallen
    return _neighbors(points, ptr, k, radius, queries, queries_ptr, grid)


@kernel("nearest_by_norm", "cpu")
def nearest_by_norm(
    points: Tensor, ptr: Tensor, norm: str, k: int, queries: Tensor, queries_ptr: Tensor, limit: Tensor
) -> tuple[Tensor, Tensor]:
    """Search in the wide trees within the largest limit, then leave out what is beyond each query's own."""
    if not points.shape[1] or max(k, len(points)) > _MAX_ROWS:
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
    if points.shape[1] != 3 or len(points) > _MAX_ROWS:
        search = functools.partial(nearest_rows, points, ptr, grid=grid)
        return grown_within(search, points, ptr, radius, queries, queries_ptr, exclude_self)
    return _listed(_tree(points, ptr, _MAX_ROWS), radius, queries, queries_ptr, exclude_self)


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
        groups = _tree(queries, queries_ptr, _MAX_ROWS)
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
    if points.shape[1] != 3 or len(points) > _MAX_ROWS:
        return {}
    return _tree(points, ptr, _COPIES)


def _tree(points: Tensor, ptr: Tensor, copies: int) -> dict[str, Tensor]:
    """Return the leaves and boxes of points, of equal ones so many."""
    points, ptr = _rows(points, ptr)
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
    if not prepared or k > (_MAX_ROWS if is_whole else _COPIES):
        return nearest_rows(points, ptr, k, queries=queries, queries_ptr=queries_ptr, radius=radius)
    if queries is None and not is_whole:
        queries, queries_ptr = points, ptr
    num_queries = len(points)
    if queries is not None:
        assert queries_ptr is not None
        queries, queries_ptr = _rows(queries, queries_ptr)
        num_queries = len(queries)
    index, distance = room((num_queries, k), torch.int64), room((num_queries, k), torch.float32)
    tree = prepared["leaves"], prepared["leaf_ptr"], len(ptr) - 1, prepared["boxes"], len(points)
    call("pc_indexed_neighbors", *tree, queries, queries_ptr, k, *_limits(radius), index, distance)
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


@kernel("statistical_outlier_mask", "cpu")
def statistical_outlier_mask(
    *, points: Tensor, ptr: Tensor, num_neighbors: int, std_ratio: float, grid: ImageGrid | None
) -> Tensor:
    """Run the reference's contract in the core."""
    points, ptr = _rows(points, ptr)
    mean = room(len(points), torch.float64)
    outlier = room(len(points), torch.bool)
    call(
        "pc_statistical_outliers",
        *(points, ptr, len(ptr) - 1, _reachable(num_neighbors, points), std_ratio),
        *(*_grid_arguments(grid), mean, outlier),
    )
    return outlier


@kernel("estimate_normals", "cpu")
def estimate_normals(
    *, points: Tensor, ptr: Tensor, radius: float | None, max_neighbors: int, grid: ImageGrid | None
) -> Tensor:
    """Run the reference's contract in the core."""
    points, ptr = _rows(points, ptr)
    normals = room(points.shape, points.dtype)
    most = _reachable(max_neighbors, points)
    call("pc_normals", points, ptr, len(ptr) - 1, most, _limit(radius), *_grid_arguments(grid), normals)
    return normals


@kernel("facing_normals", "cpu")
def facing_normals(points: Tensor, normals: Tensor, viewpoint: Tensor) -> Tensor:
    """Turn them in one pass; another dtype than float32 is the reference's."""
    if any(one.dtype is not torch.float32 for one in (points, normals, viewpoint)):
        found: Tensor = INNER["facing_normals"].reference(points, normals, viewpoint)
        return found
    facing, of_all = room(normals.shape, torch.float32), viewpoint.numel() == 3
    arrays = points.contiguous(), normals.contiguous(), points.shape[0], viewpoint.contiguous()
    call("pc_face_normals", *arrays, of_all, facing)
    return facing


@kernel("neighborhood_shapes", "cpu")
def neighborhood_shapes(points: Tensor, index: Tensor, centers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sum up one neighborhood after another."""
    queries, k = index.shape
    mean, covariance = room_for(((queries, 3), torch.float32), ((queries, 3, 3), torch.float64))
    counts = room(queries, torch.int64)
    arrays = points.detach().contiguous(), len(points), index.contiguous(), queries, k, centers.contiguous()
    call("pc_neighborhood_shapes", *arrays, mean, covariance, counts)
    return mean, covariance, counts


def _neighbors(
    points: Tensor,
    ptr: Tensor,
    k: int,
    radius: float | Tensor | None,
    queries: Tensor | None,
    queries_ptr: Tensor | None,
    grid: ImageGrid | None,
) -> tuple[Tensor, Tensor]:
    points, ptr = _rows(points, ptr)
    num_queries = len(points)
    if queries is not None:
        assert queries_ptr is not None
        queries, queries_ptr = _rows(queries, queries_ptr)
        num_queries = len(queries)
    index = room((num_queries, k), torch.int64)
    distance = room((num_queries, k), torch.float32)
    call(
        "pc_neighbors",
        *(points, ptr, len(ptr) - 1, queries, queries_ptr, k, *_limits(radius)),
        *(*_grid_arguments(grid), index, distance),
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
    points, ptr = _rows(points, ptr)
    num_queries = len(points)
    if queries is not None:
        assert queries_ptr is not None
        queries, queries_ptr = _rows(queries, queries_ptr)
        num_queries = len(queries)
    index, distance = room((num_queries, k), torch.int64), room((num_queries, k), torch.float32)
    arrays = points, ptr, len(ptr) - 1, points.shape[1], queries, queries_ptr
    call("pc_wide_neighbors", *arrays, k, limit, NORMS.index(norm), index, distance)
    return index, distance


def _mean_to_nearest(queries: Tensor, queries_ptr: Tensor, points: Tensor, ptr: Tensor, squared: bool) -> Tensor:
    """Return (B,) float64: the mean (squared) distance from every query to the nearest point of its cloud."""
    points, ptr = _rows(points, ptr)
    queries, queries_ptr = _rows(queries, queries_ptr)
    distance = room(len(queries), torch.float32)
    call("pc_nearest_squared", points, ptr, len(ptr) - 1, queries, queries_ptr, distance)
    return mean_per_cloud(distance if squared else distance.sqrt_(), queries_ptr)


def _rows(points: Tensor, ptr: Tensor) -> tuple[Tensor, Tensor]:
    if points.shape[0] > _MAX_ROWS:
        raise ValueError(f"the compiled core takes at most {_MAX_ROWS} points in a call, got {len(points)}")
    return (points.detach() if points.requires_grad else points).contiguous(), ptr.contiguous()


def _reachable(count: int, points: Tensor) -> int:
    """Return a number of neighbors that gives the same answer and fits the 31 bits of the core."""
    return min(count, max(1, len(points)))


@functools.lru_cache(maxsize=256)
def _limit(radius: float | None) -> float:
    return float(largest_squared(radius, torch.device("cpu")))


def _limits(radius: float | Tensor | None) -> tuple[float, Tensor | None]:
    """Return the limit of squared distances of all queries, and those of each where they have radii of their own."""
    if isinstance(radius, Tensor):
        return 0.0, largest_squared(radius, radius.device).contiguous()
    return _limit(radius), None


@kernel("radius_outlier_mask", "cpu")
def radius_outlier_mask(
    points: Tensor, ptr: Tensor, min_neighbors: int, radius: float, grid: ImageGrid | None
) -> Tensor:
    """Search the points stored before and after each one, then the cells around those that are left."""
    return _radius_outliers(points, ptr, None, min_neighbors, radius, grid)


@kernel("radius_outliers_within", "cpu")
def radius_outliers_within(
    points: Tensor, ptr: Tensor, within: Tensor, min_neighbors: int, radius: float, grid: ImageGrid | None
) -> Tensor:
    """Do so, and pass over what is no point."""
    if grid is not None:
        grid = checked_grid("radius_outlier_mask", "grid", {"grid": grid, "points": points, "ptr": ptr})
    return _radius_outliers(points, ptr, within.contiguous(), min_neighbors, radius, grid)


def _radius_outliers(
    points: Tensor, ptr: Tensor, within: Tensor | None, min_neighbors: int, radius: float, grid: ImageGrid | None
) -> Tensor:
    points, ptr = _rows(points, ptr)
    outlier = room(len(points), torch.bool)
    largest = room(1, torch.float64)
    enough = min(min_neighbors, len(points))  # as unreachable as any larger number, and fits an int64
    call(
        "pc_radius_outlier_mask",
        *(points, ptr, len(ptr) - 1, radius, enough),
        *(*_grid_arguments(grid)[:2], within, outlier, largest),
    )
    require_cells("radius_outlier_mask", radius, largest.item())
    return outlier


@kernel("density_clusters", "cpu")
def density_clusters(points: Tensor, ptr: Tensor, eps: float, min_points: int, grid: ImageGrid | None) -> Tensor:
    """Join cells that hold core points, then number the clusters and label their borders."""
    label = room(len(points), torch.int64)
    largest = room(1, torch.float64)
    enough = min(min_points, len(points) + 1)
    call("pc_dbscan", points, ptr, len(ptr) - 1, eps, enough, label, largest)
    require_cells("dbscan", eps, largest.item())
    return label


def _grid_arguments(grid: ImageGrid | None) -> tuple[Tensor | None, int, Tensor | None]:
    """Return what the core wants of a grid: pixels, width, motions into the cameras' frames."""
    if grid is None:
        return None, 0, None
    motion = grid.camera_from_points
    return (
        grid.pixel_index.contiguous(),
        grid.size[1],
        None if motion is None else motion.detach().double().contiguous(),
    )
