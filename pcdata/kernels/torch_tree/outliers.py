"""Radius outliers: a crowded cell needs no distances, the rest asks the tree."""

from __future__ import annotations

from torch import Tensor

import pcdata.functional.outliers  # noqa: F401 - the operation must be registered before its kernel
from pcdata.contracts.dispatch import kernel
from pcdata.contracts.on_host import counts_of
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.rows import picked_rows
from pcdata.kernels.torch_tree.cells import Cells
from pcdata.kernels.torch_tree.search import nearest_chunks


@kernel("radius_outlier_mask", "torch_tree")
def radius_outlier_mask(
    points: Tensor, ptr: Tensor, min_neighbors: int, radius: float, grid: ImageGrid | None
) -> Tensor:
    """Count the points of every cell, then search around those in cells that are not full."""
    # All points of a cell are within the radius of each other: a full cell needs no distances.
    outlier = Cells.within("radius_outlier_mask", points, ptr, radius).crowd() <= min_neighbors
    undecided, undecided_ptr = picked_rows(outlier, ptr)
    if len(undecided) == 0 or min_neighbors >= max(counts_of(ptr)):  # in no cloud there are enough
        return outlier
    searches = nearest_chunks(
        points,
        ptr,
        min_neighbors + 1,
        queries=points[undecided],
        queries_ptr=undecided_ptr,
        radius=radius,
    )
    for query, squared, _ in searches:
        outlier[undecided[query]] = ~squared.isfinite().all(1)
    return outlier
