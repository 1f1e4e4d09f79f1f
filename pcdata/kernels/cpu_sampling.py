"""Sampling kernels: planes, voxels, farthest points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pcdata.dispatch import OPERATIONS, kernel
from pcdata.functional.parameters import require_count
from pcdata.functional.planes import PlaneWork, plane_of_moments, search_planes
from pcdata.functional.ragged import counts_from_ptr, ptr_from_counts
from pcdata.functional.sampling import check_available, counts_per_cloud
from pcdata.functional.voxels import count_voxels, search_voxel_sizes, sizes_per_cloud
from pcdata.kernels.native import call

# The core numbers the rows of one cloud, and voxels, with 32 bits.
_MAX_ROWS = 2**31 - 1


@kernel("farthest_point_sample", "cpu")
def farthest_point_sample(
    points: Tensor, ptr: Tensor, *, num_samples: int | Sequence[int] | Tensor
) -> tuple[Tensor, Tensor]:
    """Visit only the points that a pick can change."""
    wanted = counts_per_cloud("farthest_point_sample", num_samples, ptr)
    check_available("farthest_point_sample", wanted, ptr)
    if _too_long(ptr):
        return _reference("farthest_point_sample", points, ptr, num_samples=num_samples)
    picks, counts = torch.empty(sum(wanted), dtype=torch.int64), torch.tensor(wanted)
    call("pc_farthest_points", points.contiguous(), ptr.contiguous(), len(wanted), counts, picks)
    return picks.add_(torch.repeat_interleave(ptr[:-1], counts)), ptr_from_counts(counts)


@kernel("voxel_downsample", "cpu")
def voxel_downsample(
    points: Tensor, ptr: Tensor, *, voxel_size: float | Sequence[float] | Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Number voxels in a hash table; sums are integers, so threads change nothing."""
    sizes = sizes_per_cloud("voxel_downsample", voxel_size, ptr).contiguous()
    if _too_long(ptr):
        return _reference("voxel_downsample", points, ptr, voxel_size=voxel_size)
    # As many rows as there could be: those not written never become memory.
    means, inverse = torch.empty_like(points), torch.empty(len(points), dtype=torch.int64)
    counts, spans_too_many = torch.empty(len(ptr) - 1, dtype=torch.int64), torch.zeros(1, dtype=torch.int64)
    arrays = points.contiguous(), ptr.contiguous(), len(ptr) - 1, sizes, means, inverse, counts, spans_too_many
    call("pc_voxel_downsample", *arrays)
    if spans_too_many:
        return _reference("voxel_downsample", points, ptr, voxel_size=voxel_size)  # knows what to say
    means_ptr = ptr_from_counts(counts)
    # Not clone(): see pcdata.checks on torch's threads.
    return torch.from_numpy(means[: int(means_ptr[-1])].numpy().copy()), means_ptr, inverse


@kernel("find_voxel_size", "cpu")
def find_voxel_size(points: Tensor, ptr: Tensor, *, num_points: int) -> Tensor:
    """Bisect like the reference; only counting is different."""
    require_count("find_voxel_size", "num_points", num_points)
    if _too_long(ptr):
        return _reference("find_voxel_size", points, ptr, num_points=num_points)
    return search_voxel_sizes(points.contiguous(), ptr, num_points, _count_voxels, _count_distinct)


def _count_voxels(points: Tensor, voxel_size: float) -> int:
    ptr, size = torch.tensor([0, len(points)]), torch.tensor([voxel_size], dtype=torch.float64)
    counts, spans_too_many = torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.int64)
    call("pc_count_voxels", points, ptr, 1, size, counts, spans_too_many)
    return count_voxels(points, voxel_size) if spans_too_many else int(counts)


def _count_distinct(points: Tensor) -> int:
    distinct = torch.empty(1, dtype=torch.int64)
    call("pc_count_distinct", points, len(points), distinct)
    return int(distinct)


@kernel("ransac_plane", "cpu")
def ransac_plane(
    points: Tensor,
    ptr: Tensor,
    *,
    distance: float,
    num_hypotheses: int,
    seed: int | Sequence[int] | Tensor,
    up: Tensor | Sequence[float] | None,
    max_tilt: float | None,
) -> tuple[Tensor, Tensor]:
    """Score all hypotheses in one pass over the points; draws and refinement are the reference's."""
    work = PlaneWork(_count_inliers, _inlier_mask, _fit)
    return search_planes(points.contiguous(), ptr, work, distance, num_hypotheses, seed, up, max_tilt)


def _count_inliers(points: Tensor, planes: Tensor, distance: float) -> Tensor:
    counts = torch.empty(len(planes), dtype=torch.int64)
    call("pc_count_near_planes", points, len(points), planes.float().contiguous(), len(planes), float(distance), counts)
    return counts


def _inlier_mask(points: Tensor, plane: Tensor, distance: float) -> Tensor:
    near = torch.empty(len(points), dtype=torch.bool)
    call("pc_near_plane", points, len(points), plane.float().contiguous(), float(distance), near)
    return near


def _fit(points: Tensor, chosen: Tensor) -> Tensor | None:
    # Offsets from a point of the plane are no longer than the plane is wide, so their squares keep their digits.
    sums, origin = torch.empty(11, dtype=torch.float64), points[int(chosen.numpy().argmax())].double()
    call("pc_moments", points, chosen, len(points), origin, sums)
    count, largest = float(sums[0]), sums[1]
    if count < 3:
        return None
    mean = sums[2:5] / count
    xx, xy, xz, yy, yz, zz = (sums[5:] / count).unbind()
    covariance = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).reshape(3, 3) - torch.outer(mean, mean)
    return plane_of_moments(origin + mean, covariance, largest)


def _too_long(ptr: Tensor) -> bool:
    return int(counts_from_ptr(ptr).max()) > _MAX_ROWS


def _reference(operation: str, *args: Any, **kwargs: Any) -> Any:
    return OPERATIONS[operation].reference(*args, **kwargs)
