"""Outlier kernels: mean distances are found by the search for neighbors, points within a radius counted in cells."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

import pcdata.functional.outliers  # noqa: F401 - the operations must be registered before their kernels
from pcdata.contracts.dispatch import held_to, kernel
from pcdata.functional.image_grid import ImageGrid, checked_grid
from pcdata.functional.radius import require_cells
from pcdata.functional.rows import KeptRows
from pcdata.kernels.cpu.native import answers, call, room
from pcdata.kernels.cpu.search_arguments import core_rows, grid_arguments, reachable


@kernel("statistical_outlier_mask", "cpu")
def statistical_outlier_mask(
    *, points: Tensor, ptr: Tensor, num_neighbors: int, std_ratio: float, grid: ImageGrid | None
) -> Tensor:
    """Run the reference's contract in the core."""
    outlier = room(points.shape[0], torch.bool)
    _mark_unusual(points, ptr, num_neighbors, std_ratio, grid, (outlier, None, None))
    return outlier


@kernel("usual_rows", "cpu")
def usual_rows(points: Tensor, ptr: Tensor, num_neighbors: int, std_ratio: float, grid: ImageGrid | None) -> KeptRows:
    """Do so, turn the marks and count them in the same call."""
    held = held_to(
        "statistical_outlier_mask",
        **{"points": points, "ptr": ptr, "num_neighbors": num_neighbors, "std_ratio": std_ratio, "grid": grid},
    )
    kept = _room_for_kept(points, ptr)
    _mark_unusual(**held, marks=kept)
    return kept


@kernel("radius_outlier_mask", "cpu")
def radius_outlier_mask(
    points: Tensor, ptr: Tensor, min_neighbors: int, radius: float, grid: ImageGrid | None
) -> Tensor:
    """Search the points stored before and after each one, then the cells around those that are left."""
    outlier = room(points.shape[0], torch.bool)
    _mark_lonely(points, ptr, min_neighbors, radius, grid, None, (outlier, None, None))
    return outlier


@kernel("rows_in_company", "cpu")
def rows_in_company(
    points: Tensor, ptr: Tensor, min_neighbors: int, radius: float, grid: ImageGrid | None, within: Tensor | None = None
) -> KeptRows:
    """Do so, pass over what is no point, turn the marks and count them in the same call."""
    held: dict[str, Any] = {
        "points": points,
        "ptr": ptr,
        "min_neighbors": min_neighbors,
        "radius": radius,
        "grid": grid,
    }
    if within is None:
        held = held_to("radius_outlier_mask", **held)
    elif grid is not None:  # the pixels of all rows, though not all are points
        held["grid"] = checked_grid("radius_outlier_mask", "grid", held)
    kept = _room_for_kept(points, ptr)
    _mark_lonely(**held, within=None if within is None else within.contiguous(), marks=kept)
    return kept


Marks = tuple[Tensor, Tensor | None, Tensor | None]  # of outliers alone, or KeptRows


def _room_for_kept(points: Tensor, ptr: Tensor) -> KeptRows:
    rows, clouds = points.shape[0], ptr.shape[0] - 1
    return KeptRows(room(rows, torch.bool), room(clouds + 1, torch.int64), room(clouds, torch.int64))


def _mark_unusual(
    points: Tensor, ptr: Tensor, num_neighbors: int, std_ratio: float, grid: ImageGrid | None, marks: Marks
) -> None:
    points, ptr = core_rows(points, ptr)
    most = reachable(num_neighbors, points)
    call(
        "pc_statistical_outliers",
        *(points, ptr, ptr.shape[0] - 1, most, std_ratio, *grid_arguments(grid), None, *marks),
    )


def _mark_lonely(
    points: Tensor,
    ptr: Tensor,
    min_neighbors: int,
    radius: float,
    grid: ImageGrid | None,
    within: Tensor | None,
    marks: Marks,
) -> None:
    points, ptr = core_rows(points, ptr)
    largest = answers(kind=ctypes.c_double)
    enough = min(min_neighbors, points.shape[0])  # as unreachable as any larger number, and fits an int64
    call(
        "pc_radius_outlier_mask",
        *(points, ptr, ptr.shape[0] - 1, radius, enough, *grid_arguments(grid)[:2], within, *marks, largest),
    )
    require_cells("radius_outlier_mask", radius, largest[0])
