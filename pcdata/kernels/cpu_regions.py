"""Cell kernels: radius outliers, DBSCAN."""

from __future__ import annotations

import torch
from torch import Tensor

# The operations must be registered before their kernels.
import pcdata.functional.clusters
import pcdata.functional.outliers  # noqa: F401
from pcdata.dispatch import kernel
from pcdata.functional.cells import require_cells
from pcdata.functional.grid import ImageGrid
from pcdata.functional.parameters import check_grid, require_count, require_length
from pcdata.kernels import native


@kernel("radius_outlier_mask", "cpu")
@torch.no_grad()
def radius_outlier_mask(
    points: Tensor, ptr: Tensor, min_neighbors: int, radius: float, grid: ImageGrid | None
) -> Tensor:
    """Search the points stored before and after each one, then the cells around those that are left."""
    where = "radius_outlier_mask"
    require_count(where, "min_neighbors", min_neighbors)
    require_length(where, "radius", radius)
    check_grid(where, grid, points, ptr)
    outlier = torch.empty(len(points), dtype=torch.bool)
    largest = torch.zeros(1, dtype=torch.float64)
    enough = min(min_neighbors, len(points))  # as unreachable as any larger number, and fits an int64
    native.call(
        "pc_radius_outlier_mask",
        points.contiguous(),
        ptr.contiguous(),
        len(ptr) - 1,
        float(radius),
        enough,
        None if grid is None else grid.pixel_index.contiguous(),
        0 if grid is None else grid.size[1],
        outlier,
        largest,
    )
    require_cells(where, radius, largest.item())
    return outlier


@kernel("dbscan", "cpu")
@torch.no_grad()
def dbscan(points: Tensor, ptr: Tensor, eps: float, min_points: int, grid: ImageGrid | None) -> Tensor:
    """Join cells that hold core points, then number the clusters and label their borders."""
    require_count("dbscan", "min_points", min_points)
    require_length("dbscan", "eps", eps)
    check_grid("dbscan", grid, points, ptr)
    label = torch.empty(len(points), dtype=torch.int64)
    largest = torch.zeros(1, dtype=torch.float64)
    enough = min(min_points, len(points) + 1)
    native.call("pc_dbscan", points.contiguous(), ptr.contiguous(), len(ptr) - 1, float(eps), enough, label, largest)
    require_cells("dbscan", eps, largest.item())
    return label
