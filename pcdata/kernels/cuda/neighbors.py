"""Nearest neighbors: every query walks down a tree of boxes, 32 of them together."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

import pcdata.functional.neighbors  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.nearest import Neighbors
from pcdata.functional.neighbors import Listed, grown_within
from pcdata.functional.radius import largest_squared
from pcdata.kernels.cuda.launching import Launcher, launcher_of
from pcdata.kernels.cuda.trees import BoxTree, box_tree, in_order

_MOST_ROWS = 2**31 - 2  # rows have 32 bits in a key
_FEW = (8, 16, 32, 64)  # neighbors that a thread keeps to itself
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
    launcher = launcher_of(points)
    tree = box_tree(launcher, points.detach().contiguous(), ptr.contiguous())
    index, distance, _ = searched(launcher, tree, k, **own)
    return index, distance


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
    """Find the neighbors of all queries, and yield them at once."""
    own: dict[str, Any] = {"queries": queries, "queries_ptr": queries_ptr, "radius": radius}
    if points.shape[1] != 3 or max(k, len(points)) > _MOST_ROWS:
        yield from INNER["nearest_chunks"].reference(points, ptr, k, **own)
        return
    launcher = launcher_of(points)
    tree = box_tree(launcher, points.detach().contiguous(), ptr.contiguous())
    index, squared, _ = searched(launcher, tree, k, **own, squared=True)
    yield torch.arange(len(index), dtype=torch.int64, device=points.device), squared, index


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


def searched(
    launcher: Launcher,
    tree: BoxTree,
    k: int,
    *,
    queries: Tensor | None = None,
    queries_ptr: Tensor | None = None,
    radius: float | Tensor | None = None,
    squared: bool = False,
    means: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return rows (Q, k), distances or their squares (Q, k), and, instead of both, mean distances (Q,) float64."""
    order, device = tree.order, tree.points.device
    if queries is None or queries_ptr is None:
        queries, queries_ptr = tree.points, tree.ptr
    else:
        queries, queries_ptr = queries.detach().contiguous(), queries_ptr.contiguous()
        order = in_order(launcher, queries, queries_ptr, tree.box)
    count, width = len(queries), 0 if means else k
    index = torch.empty((count, width), dtype=torch.int64, device=device)
    told = torch.empty((count, width), dtype=torch.float32, device=device)
    mean = torch.empty(count if means else 0, dtype=torch.float64, device=device)
    limits = largest_squared(radius, device).contiguous() if isinstance(radius, Tensor) else None
    limit = float(largest_squared(None if isinstance(radius, Tensor) else radius, torch.device("cpu")))
    most = next((str(few) for few in _FEW if k <= few), "many")
    if means and most == "many":
        raise ValueError(f"means are of at most {_FEW[-1]} neighbors, not {k}; please report this")
    launcher.launch(
        f"pc_nearest_{most}",
        *(count, queries, queries_ptr, order, tree.ptr, len(tree.ptr) - 1, count, k, limit, limits),
        *(tree.placed, len(tree.points), tree.sides, tree.least_rows, tree.nodes),
        *(len(tree.points), index, told, int(squared), mean if means else None),
        block=_BLOCK,
    )
    return index, told, mean
