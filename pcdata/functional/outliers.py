"""Masks of stray points, with Open3D's semantics so that the masks can be compared exactly.

Source: Open3D ``PointCloud.remove_statistical_outlier`` and ``remove_radius_outlier`` (legacy geometry), whose edge
cases were found by experiment; Rusu et al., Toward 3D point cloud based object maps, RAS 2008.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.numbers import checked_count, checked_length, checked_positive
from pcdata.contracts.operators import Traced
from pcdata.functional.image_grid import ImageGrid, checked_grid
from pcdata.functional.nearest import nearest_chunks, pair_chunks, rooted
from pcdata.functional.radius import require_extent, squared_radius
from pcdata.functional.rows import KeptRows, cloud_of_rows, counts_from_ptr, kept_rows, ptr_after_mask

# Interleaved sums: as many as threads of a GPU that work together.
_RUNS = 1024


def _mask_of(points: Tensor) -> Tensor:
    """Return an empty mask like the result."""
    return points.new_empty(points.shape[0], dtype=torch.bool)


@op(
    points="N 3",
    ptr="ptr N B",
    num_neighbors=checked_count,
    std_ratio=checked_positive,
    grid=checked_grid,
    steps=(nearest_chunks,),
    gradient=False,
    traced=Traced(
        "Tensor points, Tensor? ptr, int num_neighbors, float std_ratio",
        "Tensor outlier",
        lambda points, **_: _mask_of(points),
    ),
)
def statistical_outlier_mask(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    num_neighbors: int = 20,
    std_ratio: float = 2.0,
    grid: ImageGrid | None = None,
    backend: str = "auto",
) -> Tensor:  # (N,) bool, True = outlier
    """Mark points whose mean distance to their nearest neighbors is unusual for their cloud.

    A point stays when 0 < mean < mu + std_ratio * sigma. ``mean`` is over its ``num_neighbors`` nearest points, itself
    included at distance 0 (all points, in a smaller cloud); mu is the average of the means over the cloud; sigma their
    sample deviation, n - 1. Distances are the float32 ones of :func:`knn`, all sums are float64: those of distances are
    exact, in whatever order, where the nearest is more than a millionth of the farthest, so backends agree on means.

    As in Open3D: points with ``num_neighbors`` or more copies at one spot have mean 0, so they are outliers and add
    nothing to sigma; and where sigma cannot separate anything, all points are outliers: clouds of one or two points,
    clouds whose means are all equal, ``num_neighbors=1``.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
        ConfigError: num_neighbors is less than 1, or std_ratio is not positive.
    """
    assert ptr is not None  # @op fills it
    mean = torch.zeros(len(points), dtype=torch.float64, device=points.device)
    for query, squared, _ in nearest_chunks(points, ptr, num_neighbors, backend=backend):
        found = squared.isfinite()
        distance = torch.where(found, rooted(squared), 0.0).double()
        mean[query] = distance.sum(1) / found.sum(1)
    cloud, counts = cloud_of_rows(ptr), counts_from_ptr(ptr).double()
    average = _interleaved_sum(mean, ptr) / counts
    spread = torch.where(mean > 0, (mean - average[cloud]) ** 2, 0.0)
    # NaN for one point: every comparison is then false.
    deviation = (_interleaved_sum(spread, ptr) / (counts - 1)).sqrt()
    threshold = average + std_ratio * deviation
    return ~((mean > 0) & (mean < threshold[cloud]))


@inner
def usual_rows(points: Tensor, ptr: Tensor, num_neighbors: int, std_ratio: float, grid: ImageGrid | None) -> KeptRows:
    """Keep the rows that :func:`statistical_outlier_mask` does not mark; raises what that raises."""
    outlier = statistical_outlier_mask(points, ptr, num_neighbors=num_neighbors, std_ratio=std_ratio, grid=grid)
    return kept_rows(outlier, ptr, gone=True)


def _interleaved_sum(values: Tensor, ptr: Tensor) -> Tensor:
    """Sum each cloud's values in interleaved runs, then add halves of these to each other: every backend rounds alike.

    The mask hangs on the last bit where all means are equal.
    """
    cloud = cloud_of_rows(ptr)
    run = cloud * _RUNS + (torch.arange(len(values), dtype=torch.int64, device=values.device) - ptr[cloud]) % _RUNS
    runs = values.new_zeros(_RUNS * (len(ptr) - 1)).index_add(0, run, values).reshape(-1, _RUNS)
    while runs.shape[1] > 1:
        one, other = runs.chunk(2, dim=1)
        runs = one + other
    return runs[:, 0]


@op(
    points="N 3",
    ptr="ptr N B",
    min_neighbors=checked_count,
    radius=checked_length,
    grid=checked_grid,
    gradient=False,
    traced=Traced(
        "Tensor points, Tensor? ptr, int min_neighbors, float radius",
        "Tensor outlier",
        lambda points, **_: _mask_of(points),
    ),
)
def radius_outlier_mask(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    min_neighbors: int = 5,
    radius: float = 0.01,
    grid: ImageGrid | None = None,
    backend: str = "auto",
) -> Tensor:  # (N,) bool, True = outlier
    """Mark points with too few neighbors: a point stays when more than ``min_neighbors`` points have d < radius.

    As in Open3D the point counts itself and both tests are strict; d < radius is
    ``d2 < float32(radius) * float32(radius)``.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers of the points.
        min_neighbors: this many, the point itself included, are not yet enough.
        radius: in the unit of the points.
        grid: the depth image the points still lie on; same answers, lets kernels search pixel windows.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
        ConfigError: min_neighbors is less than 1, the radius is not a positive length, or it is too small for the
            extent of the cloud (see :mod:`pcdata.functional.radius`).
    """
    assert ptr is not None  # @op fills it
    require_extent("radius_outlier_mask", points, ptr, radius)
    limit = squared_radius(radius, points.device)
    outlier = torch.empty(len(points), dtype=torch.bool, device=points.device)
    for pairs in pair_chunks(points, ptr, points, ptr):
        outlier[pairs.query] = (pairs.squared < limit).sum(1) <= min_neighbors
    return outlier


@inner
def rows_in_company(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor,  # (B+1,)
    min_neighbors: int,
    radius: float,
    grid: ImageGrid | None,
    within: Tensor | None = None,  # (N,) bool: the points that there are, all of them finite
) -> KeptRows:
    """Keep the rows that :func:`radius_outlier_mask` does not mark; raises what that raises."""
    fields: dict[str, Any] = {"min_neighbors": min_neighbors, "radius": radius}
    if within is None:
        return kept_rows(radius_outlier_mask(points, ptr, **fields, grid=grid), ptr, gone=True)
    left = None if grid is None else replace(grid, pixel_index=grid.pixel_index[within])
    outlier = torch.zeros_like(within)
    outlier[within] = radius_outlier_mask(points[within], ptr_after_mask(within, ptr), **fields, grid=left)
    return kept_rows(outlier, ptr, gone=True, within=within)
