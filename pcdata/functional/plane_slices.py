"""Planes that cut through things, beside those that are surfaces."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pcdata.functional.neighbor_rows import nearest_rows
from pcdata.functional.normals import covariance, smallest_eigenvector
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
    own, has_plane = label.clamp(min=0), label >= 0
    whole = torch.zeros(len(planes), dtype=torch.int64, device=label.device).index_add_(0, own, has_plane.long())
    is_parallel = (planes[:, :3] @ planes[:, :3].T).abs() > _PARALLEL
    may_be_slice = (is_parallel & (whole > whole[:, None])).any(1)
    rows = (has_plane & may_be_slice[own]).nonzero().squeeze(1)
    if not len(rows):
        return label
    everywhere, here = (ptr_from_counts([count], device=voxels.device) for count in (len(voxels), len(rows)))
    asked = voxels[rows]
    nearest, apart = nearest_rows(
        voxels, everywhere, _NEIGHBORS, queries=asked, queries_ptr=here, radius=_REACH * distance, backend=backend
    )
    there = apart.isfinite()
    count = there.sum(1)
    # A neighbor that is missing is the voxel itself and adds nothing to sums of offsets.
    offset = (voxels[torch.where(there, nearest, rows[:, None])] - asked[:, None]).double()
    normal = smallest_eigenvector(*covariance(offset, count))
    along = (offset * normal[:, None]).sum(-1)
    across = along.square().sum(1) - along.sum(1).square() / count
    total = offset.square().sum((1, 2)) - offset.sum(1).square().sum(1) / count
    is_flat = (count >= _FEWEST) & (across < _FLAT * total)
    own = own[rows]
    is_across = is_flat & ((normal * planes[own, :3]).sum(1).abs() < _ALONG)
    cut = torch.zeros_like(whole).index_add_(0, own, is_across.long())
    is_taken = is_across & (cut > _MOST_ACROSS * whole)[own]
    return label.index_put((rows,), torch.where(is_taken, -1, own))
