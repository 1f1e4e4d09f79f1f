"""Outliers: by the mean distance to the nearest, and by the number of neighbors within a radius."""

from __future__ import annotations

import torch
from torch import Tensor

import pcdata.functional.outliers  # noqa: F401 - the operation must be registered before its kernel
from pcdata.contracts.dispatch import OPERATIONS, kernel
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.radius import cell_side, squared_radius
from pcdata.kernels.cuda.cells import MOST_ROWS, cell_table, hold_to_extent
from pcdata.kernels.cuda.launching import Launcher, launcher_of
from pcdata.kernels.cuda.neighbors import mean_distances, reachable
from pcdata.kernels.cuda.windows import Organized, organized, tile_tree

_MOST_NEIGHBORS = 64  # that a thread keeps to itself
_RUNS = 1024  # threads of a block, kRuns of the kernel
_REACH = 32  # rows looked at on either side


@kernel("radius_outlier_mask", "cuda", roomy=True)
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
    outlier = torch.ones(rows, dtype=torch.bool, device=device)
    enough = min(min_neighbors, rows)  # as unreachable as any larger number
    limit = float(squared_radius(radius, torch.device("cpu")))
    if (cloud := organized(launcher, points, ptr, grid)) is not None:
        far = _count_on_images(launcher, cloud, limit, enough, cell_side(radius), outlier)
        hold_to_extent("radius_outlier_mask", points, ptr, radius, far)
        return outlier
    undecided = torch.empty(rows, dtype=torch.int32, device=device)
    count = torch.zeros(1, dtype=torch.int32, device=device)
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


def _count_on_images(
    launcher: Launcher, cloud: Organized, limit: float, enough: int, side: float, outlier: Tensor
) -> Tensor:
    """Count in windows of pixels, then, for those without a proof, in a tree; say whether points are too far apart."""
    far = torch.zeros(1, dtype=torch.int32, device=outlier.device)
    launcher.launch("pc_count_in_windows", len(outlier), *cloud.windows, limit, enough, side, outlier, far)
    tree, clouds = tile_tree(launcher, cloud), len(cloud.ptr) - 1
    queries = len(outlier), cloud.points, cloud.ptr, cloud.rest, cloud.ptr, clouds, len(outlier), 1, limit, None
    boxes = cloud.num_rest, tree.placed, len(outlier), tree.sides, tree.least_rows, tree.nodes
    launcher.launch("pc_count_in_tree", *queries, *boxes, enough, outlier)
    return far


@kernel("statistical_outlier_mask", "cuda", roomy=True)
def statistical_outlier_mask(
    points: Tensor, ptr: Tensor, num_neighbors: int, std_ratio: float, grid: ImageGrid | None
) -> Tensor:
    """Average distances where neighbors are found; nothing waits for the device."""
    k = reachable(num_neighbors, points)
    if k > _MOST_NEIGHBORS or len(points) > MOST_ROWS:
        reference = OPERATIONS["statistical_outlier_mask"].reference
        fallen: Tensor = reference(points, ptr, num_neighbors=num_neighbors, std_ratio=std_ratio, backend="cuda")
        return fallen
    launcher = launcher_of(points)
    mean = mean_distances(launcher, points, ptr, k, grid)
    outlier = torch.ones(len(points), dtype=torch.bool, device=points.device)
    launcher.launch_blocks("pc_mark_unusual", len(ptr) - 1, mean, ptr, float(std_ratio), outlier, block=_RUNS)
    return outlier
