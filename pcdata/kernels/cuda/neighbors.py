"""Nearest neighbors: every query walks down a tree of boxes, 32 of them together."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

import pcdata.functional.neighbors
import pcdata.functional.normals  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, OPERATIONS, kernel
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.nearest import Neighbors
from pcdata.functional.neighbor_rows import Listed, grown_within
from pcdata.functional.radius import largest_squared
from pcdata.kernels.cuda.launching import Launcher, launcher_of
from pcdata.kernels.cuda.trees import BoxTree, box_tree, in_order
from pcdata.kernels.cuda.windows import organized, tile_tree

_MOST_ROWS = 2**31 - 2  # rows have 32 bits in a key
_FEW = (8, 16, 32, 64)  # neighbors that a thread keeps to itself
_CHUNK = 1 << 18  # queries
_BLOCK = 128  # threads: four warps, each with queries of its own


@kernel("nearest_rows", "cuda")
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
    """Search the tree of the points; it knows three coordinates."""
    own: dict[str, Any] = {"queries": queries, "queries_ptr": queries_ptr, "radius": radius}
    if points.shape[1] != 3 or max(k, len(points)) > _MOST_ROWS:
        fallen: tuple[Tensor, Tensor] = INNER["nearest_rows"].reference(points, ptr, k, **own, grid=grid)
        return fallen
    launcher, points, ptr = launcher_of(points), points.detach().contiguous(), ptr.contiguous()
    if grid is None or queries is not None or isinstance(radius, Tensor):
        return searched(launcher, box_tree(launcher, points, ptr), k, **own)
    index, told = _room(points, k)
    _find_own(launcher, "nearest", _FEW, points, ptr, k, radius, grid, len(points), index, told, 0)
    return index, told


@kernel("nearest_chunks", "cuda")
def nearest_chunks(
    points: Tensor,
    ptr: Tensor,
    k: int,
    *,
    queries: Tensor | None = None,
    queries_ptr: Tensor | None = None,
    radius: float | Tensor | None = None,
) -> Iterator[Neighbors]:
    """Find the neighbors of all queries, then yield some at a time: callers make larger tensors of them."""
    own: dict[str, Any] = {"queries": queries, "queries_ptr": queries_ptr, "radius": radius}
    if points.shape[1] != 3 or max(k, len(points)) > _MOST_ROWS:
        yield from INNER["nearest_chunks"].reference(points, ptr, k, **own)
        return
    launcher = launcher_of(points)
    tree = box_tree(launcher, points.detach().contiguous(), ptr.contiguous())
    index, squared = searched(launcher, tree, k, **own, squared=True)
    queried = torch.arange(len(index), dtype=torch.int64, device=points.device)
    yield from zip(queried.split(_CHUNK), squared.split(_CHUNK), index.split(_CHUNK))


@kernel("rows_within", "cuda")
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
    """Ask for more and more of the nearest."""
    search = functools.partial(nearest_rows, points, ptr, grid=grid)
    return grown_within(search, points, ptr, radius, queries, queries_ptr, exclude_self)


@kernel("estimate_normals", "cuda", roomy=True)
def estimate_normals(
    points: Tensor, ptr: Tensor, radius: float | None, max_neighbors: int, grid: ImageGrid | None
) -> Tensor:
    """Sum up each neighborhood where it was found."""
    k = reachable(max_neighbors, points)
    if k > _FEW[-1] or len(points) > _MOST_ROWS:
        reference = OPERATIONS["estimate_normals"].reference
        fallen: Tensor = reference(points, ptr, radius=radius, max_neighbors=max_neighbors, backend="cuda")
        return fallen
    launcher = launcher_of(points)
    normals = torch.empty_like(points)
    _find_own(launcher, "normals", _FEW[2:], points, ptr, k, radius, grid, normals)
    return normals


def reachable(count: int, points: Tensor) -> int:
    """Return a number of neighbors that gives the same answer, and is no larger than need be."""
    return min(count, max(1, len(points)))


def mean_distances(launcher: Launcher, points: Tensor, ptr: Tensor, k: int, grid: ImageGrid | None) -> Tensor:
    """Return (N,) float64: the mean distance of each point to its nearest ``k``, at most 64 of them."""
    mean = torch.empty(len(points), dtype=torch.float64, device=points.device)
    _find_own(launcher, "mean_distances", _FEW[2:], points, ptr, k, None, grid, mean)
    return mean


def searched(
    launcher: Launcher,
    tree: BoxTree,
    k: int,
    *,
    queries: Tensor | None = None,
    queries_ptr: Tensor | None = None,
    radius: float | Tensor | None = None,
    squared: bool = False,
) -> tuple[Tensor, Tensor]:
    """Return rows (Q, k), and distances or their squares (Q, k)."""
    order = tree.order
    if queries is None or queries_ptr is None:
        queries, queries_ptr = tree.points, tree.ptr
    else:
        queries, queries_ptr = queries.detach().contiguous(), queries_ptr.contiguous()
        order = in_order(launcher, queries, queries_ptr, tree.box)
    index, told = _room(queries, k)
    results = len(tree.points), index, told, int(squared)
    _start(launcher, "nearest", _FEW, tree, k, queries, queries_ptr, order, radius, *results)
    return index, told


def _room(queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Return room for rows (Q, k), and for distances (Q, k)."""
    size, device = (len(queries), k), queries.device
    return torch.empty(size, dtype=torch.int64, device=device), torch.empty(size, dtype=torch.float32, device=device)


def _find_own(
    launcher: Launcher,
    kind: str,
    sizes: Sequence[int],
    points: Tensor,
    ptr: Tensor,
    k: int,
    radius: float | None,
    grid: ImageGrid | None,
    *results: Any,
) -> None:
    """Search what is near each of the points: in windows of their images, the rest in a tree."""
    cloud = organized(launcher, points, ptr, grid) if k <= sizes[-1] else None
    if cloud is None:
        tree = box_tree(launcher, points, ptr)
        _start(launcher, kind, sizes, tree, k, points, ptr, tree.order, radius, *results)
        return
    size, limit = _fewest(sizes, k), float(largest_squared(radius, torch.device("cpu")))
    launcher.launch(f"pc_window_{kind}_{size}", len(points), *cloud.windows, k, limit, *results, block=_BLOCK)
    tree = tile_tree(launcher, cloud)
    _start(launcher, kind, sizes, tree, k, points, ptr, tree.order, radius, *results, some=cloud.num_rest)


def _fewest(sizes: Sequence[int], k: int) -> int | str:
    return next((size for size in sizes if k <= size), "many")


def _start(
    launcher: Launcher,
    kind: str,
    sizes: Sequence[int],
    tree: BoxTree,
    k: int,
    queries: Tensor,
    queries_ptr: Tensor,
    order: Tensor,
    radius: float | Tensor | None,
    *results: Any,
    some: Tensor | None = None,
) -> None:
    """Search with the kernel that keeps the fewest neighbors to itself, and enough; all queries or ``some`` (1,)."""
    of_each = isinstance(radius, Tensor)
    limits = largest_squared(radius, tree.points.device).contiguous() if of_each else None
    limit = float(largest_squared(None if isinstance(radius, Tensor) else radius, torch.device("cpu")))
    launcher.launch(
        f"pc_{kind}_{_fewest(sizes, k)}",
        *(len(queries), queries, queries_ptr, order, tree.ptr, len(tree.ptr) - 1, len(queries), k, limit, limits),
        *(some, tree.placed, len(tree.points), tree.sides, tree.least_rows, tree.nodes, *results),
        block=_BLOCK,
    )
