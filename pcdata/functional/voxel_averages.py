"""One row for each voxel of what its points carry: means, directions, votes, extremes."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.errors import DTypeError
from pcdata.functional.rows import group_count, group_sum


def voxel_mean(
    values: Tensor,  # (N, C) float
    inverse: Tensor,  # (N,) int64, as voxel_downsample returns it
    num_voxels: int,
) -> Tensor:  # (M, C) in the dtype of the values
    """Average rows per voxel (colors, features), summed in float64; 0 for an empty voxel.

    Raises:
        DTypeError: integers, which have no mean (labels vote: :func:`voxel_majority`).
    """
    if not values.dtype.is_floating_point:
        raise DTypeError(f"voxel_mean: values must be float, not {values.dtype}; labels go through voxel_majority")
    count = group_count(inverse, num_voxels).clamp(min=1)
    return (group_sum(values.double(), inverse, num_voxels) / count[:, None]).to(values.dtype)


def voxel_mean_direction(
    directions: Tensor,  # (N, 3) float, unit vectors
    inverse: Tensor,  # (N,) int64
    num_voxels: int,
) -> Tensor:  # (M, 3) unit vectors
    """Average directions per voxel and bring them back to unit length; directions that cancel give zero."""
    total = group_sum(directions.double(), inverse, num_voxels)
    return torch.nn.functional.normalize(total, dim=1).to(directions.dtype)


def voxel_majority(
    labels: Tensor,  # (N,) int64
    inverse: Tensor,  # (N,) int64
    num_voxels: int,
) -> Tensor:  # (M,) int64
    """Return the most frequent label of each voxel, the lowest among equals; -1 for an empty voxel.

    Raises:
        DTypeError: the labels are not int64.
    """
    if labels.dtype != torch.int64:
        raise DTypeError(f"voxel_majority: labels must be int64, not {labels.dtype}")
    names, rank = labels.unique(return_inverse=True)
    num_names = max(len(names), 1)
    pairs, votes = (inverse * num_names + rank).unique(return_counts=True)
    voxel, rank = pairs // num_names, pairs % num_names
    # More votes first, then the lower label: both in one number whose maximum wins.
    ballot = votes * num_names + (num_names - 1 - rank)
    best = torch.full((num_voxels,), -1, dtype=torch.int64, device=labels.device).scatter_reduce_(
        0, voxel, ballot, "amax"
    )
    winner = num_names - 1 - best.remainder(num_names)
    return torch.where(best < 0, -1, names[winner]) if len(names) else best


def voxel_minimum(
    values: Tensor,  # (N,) numbers
    inverse: Tensor,  # (N,) int64
    num_voxels: int,
) -> Tensor:  # (M,) in the dtype of the values
    """Return the lowest value of each voxel; 0 for an empty voxel."""
    return _extreme(values, inverse, num_voxels, "amin")


def voxel_maximum(
    values: Tensor,  # (N,) numbers
    inverse: Tensor,  # (N,) int64
    num_voxels: int,
) -> Tensor:  # (M,) in the dtype of the values
    """Return the highest value of each voxel; 0 for an empty voxel."""
    return _extreme(values, inverse, num_voxels, "amax")


def _extreme(values: Tensor, inverse: Tensor, num_voxels: int, reduce: str) -> Tensor:
    wide = values if values.is_floating_point() else values.long()
    found = torch.zeros(num_voxels, dtype=wide.dtype, device=values.device)
    return found.scatter_reduce(0, inverse, wide, reduce, include_self=False).to(values.dtype)
