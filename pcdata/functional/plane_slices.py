"""Planes that cut through things, beside those that are surfaces."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pcdata.functional.neighbor_rows import nearest_rows
from pcdata.functional.normals import estimate_normals
from pcdata.functional.rows import ptr_from_counts

_REACH, _NEIGHBORS, _FEWEST = 5, 12, 6  # two and a half edges of a voxel: what a surface is fitted to
_FLAT = 0.05  # of the variance of neighbors, across their surface: beyond, noise or an edge tells nothing
_ALONG = math.cos(math.radians(35))
_PARALLEL = math.cos(math.radians(10))
_MOST_ACROSS = 0.1  # a table has 0.03 at the feet of what stands on it, noisy floors 0.04; slices of heaps 0.05 to 0.6


def without_slices(voxels: Tensor, label: Tensor, planes: Tensor, distance: float, backend: str) -> Tensor:
    """Take from planes that cut through things, not along their surfaces, the voxels of what they cut.

    A slab through a heap, parallel to the table, holds many voxels: of the sides of all that is in it. What stands on
    the table would be a plane itself then, and nothing be left that stands on one. Only planes within 10 degrees of a
    larger one are slices: of others it is not known what they would cut through.

    Source: Schnabel et al., Efficient RANSAC for point-cloud shape detection, Computer Graphics Forum 26, 2007 (points
    belong to a plane whose normals deviate little from its own).
    """
    if len(planes) < 2:
        return label
    one = ptr_from_counts([len(voxels)], device=voxels.device)
    radius = _REACH * distance
    nearest, apart = nearest_rows(voxels, one, _NEIGHBORS, radius=radius, backend=backend)
    there = apart.isfinite()
    count = there.sum(1)
    itself = torch.arange(len(voxels), dtype=torch.int64, device=voxels.device)[:, None]
    # A neighbor that is missing is the voxel itself and adds nothing to sums of offsets.
    offset = voxels[torch.where(there, nearest, itself)] - voxels[:, None]
    normal = estimate_normals(voxels, radius=radius, max_neighbors=_NEIGHBORS, backend=backend)
    along = (offset * normal[:, None]).sum(-1)
    across = along.square().sum(1) - along.sum(1).square() / count
    total = offset.square().sum((1, 2)) - offset.sum(1).square().sum(1) / count
    is_flat = (count >= _FEWEST) & (across < _FLAT * total)
    own = label.clamp(min=0)
    is_across = (label >= 0) & is_flat & ((normal.double() * planes[own, :3]).sum(1).abs() < _ALONG)
    whole, cut = (
        torch.zeros(len(planes), dtype=torch.int64, device=label.device).index_add_(0, own, mask.long())
        for mask in (label >= 0, is_across)
    )
    is_parallel = (planes[:, :3] @ planes[:, :3].T).abs() > _PARALLEL
    is_slice = (cut > _MOST_ACROSS * whole) & (is_parallel & (whole > whole[:, None])).any(1)
    return torch.where(is_across & is_slice[own], -1, label)
