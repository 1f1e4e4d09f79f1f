"""DBSCAN: core points by cells, cells joined as they touch, clusters numbered by their lowest core row."""

from __future__ import annotations

import torch
from torch import Tensor

import pcdata.functional.clusters  # noqa: F401 - the function must be registered before its kernel
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.radius import squared_radius
from pcdata.kernels.cuda.cells import MOST_ROWS, cell_table, hold_to_extent
from pcdata.kernels.cuda.launching import launcher_of

_WARP = 32


@kernel("density_clusters", "cuda")
def density_clusters(points: Tensor, ptr: Tensor, eps: float, min_points: int, grid: ImageGrid | None) -> Tensor:
    """Label without a list of neighbors; the one wait is for the extent of the clouds, at the end."""
    rows, clouds, device = len(points), len(ptr) - 1, points.device
    if rows > MOST_ROWS:
        fallen: Tensor = INNER["density_clusters"].reference(points, ptr, eps, min_points, grid)
        return fallen
    launcher = launcher_of(points)
    points, ptr = points.detach().contiguous(), ptr.contiguous()
    limit = float(squared_radius(eps, torch.device("cpu")))
    table = cell_table(launcher, points, ptr, eps, torch.ones(1, dtype=torch.int32, device=device))
    cells = points, ptr, clouds, table.side, table.places, table.mask
    found = table.counts, table.ends, table.placed, limit
    searched = points, ptr, clouds, rows, table.side, table.places, table.mask
    core = torch.empty(rows, dtype=torch.bool, device=device)
    core_counts, parents = torch.zeros((2, len(table.counts)), dtype=torch.int32, device=device).unbind()
    wanted = min(min_points, rows + 1)  # as unreachable as any larger number
    launcher.launch("pc_mark_cores", rows, *searched, *found, wanted, table.place_of, core, core_counts, parents)
    # A warp for each cell: as many as there could be, where the device has room for them.
    warps = min(_WARP * rows, launcher.busy_threads())
    launcher.launch("pc_join_cells", warps, *cells, *found, table.listed, table.num_listed, core, core_counts, parents)
    lowest = torch.full_like(parents, torch.iinfo(torch.int32).max)
    launcher.launch("pc_find_lowest_cores", rows, rows, core, table.place_of, parents, lowest)
    is_first = torch.empty(rows, dtype=torch.int32, device=device)
    launcher.launch("pc_mark_firsts", rows, rows, core, table.place_of, parents, lowest, is_first)
    begun = is_first.cumsum(0)
    label = torch.empty(rows, dtype=torch.int64, device=device)
    launcher.launch(
        "pc_label_rows", rows, *searched, *found, table.place_of, core, core_counts, parents, lowest, begun, label
    )
    hold_to_extent("dbscan", points, ptr, eps, table.far)
    return label
