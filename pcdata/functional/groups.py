"""Reductions over groups of rows that need not be neighbours: what a voxel makes of the points in it.

``group`` (N,) int64 names the group of each row, below ``num_groups``. Every reduction ignores the order of the rows,
except for the last bits of float64 sums; on the CPU those are taken in row order.
"""

from __future__ import annotations

import torch
from torch import Tensor


def group_count(group: Tensor, num_groups: int) -> Tensor:
    """Return the (G,) int64 number of rows in each group."""
    return torch.bincount(group, minlength=num_groups)


def group_first(group: Tensor, num_groups: int) -> Tensor:
    """Return the (G,) int64 lowest row of each group; N for an empty one."""
    rows = torch.arange(len(group), dtype=torch.int64, device=group.device)
    return torch.full((num_groups,), len(group), dtype=torch.int64, device=group.device).scatter_reduce_(
        0, group, rows, "amin"
    )


def group_sum(values: Tensor, group: Tensor, num_groups: int) -> Tensor:
    """Sum (N, C) rows into (G, C), in the dtype of the values; an empty group sums to 0."""
    total = values.new_zeros((num_groups, values.shape[1]))
    return total.scatter_add_(0, group[:, None].expand_as(values), values)
