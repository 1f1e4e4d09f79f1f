"""Radius outliers: most points find enough neighbors beside them in memory, the rest looks into cells."""

from __future__ import annotations

import torch
from torch import Tensor

import pcdata.functional.outliers  # noqa: F401 - the operation must be registered before its kernel
from pcdata.contracts.dispatch import OPERATIONS, kernel
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.radius import squared_radius
from pcdata.kernels.cuda.cells import MOST_ROWS, cell_table, hold_to_extent
from pcdata.kernels.cuda.launching import launcher_of

_REACH = 32  # rows looked at on either side


@kernel("radius_outlier_mask", "cuda")
def radius_outlier_mask(
    points: Tensor, ptr: Tensor, min_neighbors: int, radius: float, grid: ImageGrid | None
) -> Tensor:
    """Count beside each row, then, for those that are left, in the cells around them."""
    rows, clouds, device = len(points), len(ptr) - 1, points.device
    if rows > MOST_ROWS:
        fallen: Tensor = OPERATIONS["radius_outlier_mask"].reference(
            points, ptr, min_neighbors=min_neighbors, radius=radius
        )
        return fallen
    launcher = launcher_of(points)
    outlier = torch.empty(rows, dtype=torch.bool, device=device)
    undecided = torch.empty(rows, dtype=torch.int32, device=device)
    count = torch.zeros(1, dtype=torch.int32, device=device)
    enough = min(min_neighbors, rows)  # as unreachable as any larger number
    limit = float(squared_radius(radius, torch.device("cpu")))
    reach = min(enough, _REACH)
    launcher.launch("pc_count_beside", rows, points, ptr, clouds, rows, limit, enough, reach, outlier, undecided, count)
    table = cell_table(launcher, points, ptr, radius, count)
    launcher.launch(
        "pc_count_around",
        *(min(rows, launcher.busy_threads()), points, ptr, clouds, table.side, table.places, table.mask),
        *(table.counts, table.ends, table.placed, limit, enough, undecided, count, table.place_of, outlier),
    )
    hold_to_extent("radius_outlier_mask", points, ptr, radius, table.far)
    return outlier
