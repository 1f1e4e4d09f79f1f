"""Cell kernels: radius outliers, DBSCAN."""

from __future__ import annotations

import torch
from torch import Tensor

# The operations must be registered before their kernels.
import pcdata.functional.clusters
import pcdata.functional.outliers  # noqa: F401
from pcdata.contracts.dispatch import kernel
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.radius import require_cells
from pcdata.kernels.cpu.image_grid import grid_arguments
from pcdata.kernels.cpu.native import call, room


@kernel("radius_outlier_mask", "cpu")
def radius_outlier_mask(
    points: Tensor, ptr: Tensor, min_neighbors: int, radius: float, grid: ImageGrid | None
) -> Tensor:
    """Search the points stored before and after each one, then the cells around those that are left."""
    outlier = room(len(points), torch.bool)
    largest = room(1, torch.float64)
    enough = min(min_neighbors, len(points))  # as unreachable as any larger number, and fits an int64
    call(
        "pc_radius_outlier_mask",
        points,
        ptr,
        len(ptr) - 1,
        radius,
        enough,
        *grid_arguments(grid)[:2],
        outlier,
        largest,
    )
    require_cells("radius_outlier_mask", radius, largest.item())
    return outlier


@kernel("dbscan", "cpu")
def dbscan(points: Tensor, ptr: Tensor, eps: float, min_points: int, grid: ImageGrid | None) -> Tensor:
    """Join cells that hold core points, then number the clusters and label their borders."""
    label = room(len(points), torch.int64)
    largest = room(1, torch.float64)
    enough = min(min_points, len(points) + 1)
    call("pc_dbscan", points, ptr, len(ptr) - 1, eps, enough, label, largest)
    require_cells("dbscan", eps, largest.item())
    return label
