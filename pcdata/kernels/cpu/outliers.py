"""Outlier kernels: mean distances are found by the search for neighbors, points within a radius counted in cells."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

import pcdata.functional.outliers  # noqa: F401 - the operations must be registered before their kernels
from pcdata.contracts.dispatch import kernel
from pcdata.functional.image_grid import ImageGrid, checked_grid
from pcdata.functional.radius import require_cells
from pcdata.kernels.cpu.native import answers, call, room
from pcdata.kernels.cpu.search_arguments import core_rows, grid_arguments, reachable


@kernel("statistical_outlier_mask", "cpu")
def statistical_outlier_mask(
    *, points: Tensor, ptr: Tensor, num_neighbors: int, std_ratio: float, grid: ImageGrid | None
) -> Tensor:
    """Run the reference's contract in the core."""
    points, ptr = core_rows(points, ptr)
    mean = room(points.shape[0], torch.float64)
    outlier = room(points.shape[0], torch.bool)
    call(
        "pc_statistical_outliers",
        *(points, ptr, ptr.shape[0] - 1, reachable(num_neighbors, points), std_ratio),
        *(*grid_arguments(grid), mean, outlier),
    )
    return outlier


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
    points, ptr = core_rows(points, ptr)
    outlier = room(points.shape[0], torch.bool)
    largest = answers(kind=ctypes.c_double)
    enough = min(min_neighbors, points.shape[0])  # as unreachable as any larger number, and fits an int64
    call(
        "pc_radius_outlier_mask",
        *(points, ptr, ptr.shape[0] - 1, radius, enough),
        *(*grid_arguments(grid)[:2], within, outlier, largest),
    )
    require_cells("radius_outlier_mask", radius, largest[0])
    return outlier
