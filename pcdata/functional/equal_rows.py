"""Numbers that are equal where rows of a cloud are: of points, of voxels, of any keys."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.on_host import read_together
from pcdata.functional.rows import cloud_of_rows, group_first


def numbered_rows(points: Tensor, ptr: Tensor) -> tuple[Tensor, int]:
    """Number the different points (N, 3) of each cloud: (N,) int64, and how many there are."""
    ranks = torch.stack([ranked(axis)[0] for axis in points.unbind(1)], dim=1)
    return ranked(voxel_keys(cloud_of_rows(ptr), ranks, len(ptr) - 1))


def voxel_keys(cloud: Tensor, voxel: Tensor, num_clouds: int) -> Tensor:
    """Number the pairs of cloud (N,) and voxel (N, 3, not negative) by (N,) int64 keys that never collide."""
    key, size = cloud, num_clouds
    (largest,) = read_together([voxel.amax(0)]) if len(voxel) else ([0, 0, 0],)
    for axis, most in zip(voxel.long().unbind(1), largest):
        axis_size = most + 1
        if size * axis_size >= 2**63:
            # Ranks are below N, so the product of two of them fits.
            key, size = ranked(key)
            axis, axis_size = ranked(axis)
        key, size = key * axis_size + axis, size * axis_size
    return key


def ranked(values: Tensor) -> tuple[Tensor, int]:
    """Number the different values in ascending order, (N,) int64, and say how many there are."""
    distinct, rank = values.unique(return_inverse=True)
    return rank, len(distinct)


def numbered_in_order(key: Tensor) -> tuple[Tensor, Tensor]:
    """Number equal keys by first appearance; return the group of each row (N,) and the first row of each group (G,)."""
    group, num_groups = ranked(key)
    first, order = group_first(group, num_groups).sort()
    position = torch.empty_like(order)
    position[order] = torch.arange(num_groups, dtype=torch.int64, device=key.device)
    return position[group], first
