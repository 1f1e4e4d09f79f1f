"""Thinning clouds on a voxel grid; what the points carry is averaged in :mod:`pcdata.functional.voxel_averages`.

The grid is Open3D's unless an origin is given: per cloud, it starts half a voxel below the lowest corner. A point's
voxel is ``floor((point - origin) / voxel_size)`` in float64.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.numbers import checked_count, checked_edges, checked_places
from pcdata.errors import ConfigError, TooFewPointsError, UnitError
from pcdata.functional.equal_rows import numbered_in_order, numbered_rows, ranked, voxel_keys
from pcdata.functional.rows import (
    cloud_of_rows,
    counts_from_ptr,
    group_count,
    group_first,
    group_sum,
    ptr_after_mask,
    ptr_from_counts,
    segment_max,
    segment_min,
)
from pcdata.geometry.roots import square_root

# Offsets inside a voxel are summed as integers of 2^-31 voxel: exact and so independent of order, threads and device.
# A sum fits 63 bits for up to 2^32 points.
_FIXED_POINT = 2.0**31
# Beyond this, float64 no longer tells neighboring voxels apart.
_MAX_VOXELS_PER_AXIS = 2.0**53
# find_voxel_size stops when the bracket is this tight; 25 halvings away from a bracket of one octave.
SIZE_TOLERANCE = 1e-6


@inner
def voxel_means(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor,  # (B+1,)
    edges: Tensor,  # (B, 1) or (B, 3) float64
    origin: Tensor | None,  # (B, 3) float64
    *,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # means (M, 3) float32, ptr (B+1,), inverse (N,) int64, members (M,) int64
    """Return the mean of the points of each voxel, whose voxel each point is, and how many points each voxel has."""
    points = points.detach()
    cloud, start, scaled = _scale_to_grid(points, ptr, edges, origin)
    voxel = scaled.floor()
    above = voxel - voxel.amin(0) if origin is not None and len(voxel) else voxel
    inverse, first = numbered_in_order(voxel_keys(cloud, above, len(ptr) - 1))
    offset = ((scaled - voxel) * _FIXED_POINT).round_().long()
    members = group_count(inverse, len(first))
    mean_offset = group_sum(offset, inverse, len(first)).double() / members[:, None] / _FIXED_POINT
    owner = cloud[first]
    means = (start[owner] + (voxel[first] + mean_offset) * edges[owner]).float()
    return means, ptr_from_counts(group_count(owner, len(ptr) - 1)), inverse, members


class _OfMembers(torch.autograd.Function):
    """Means that are known already, with the gradient of a mean: every member takes its share."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, means: Tensor, inverse: Tensor, members: Tensor) -> Tensor:
        ctx.save_for_backward(inverse, members)
        return means

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        inverse, members = ctx.saved_tensors
        shares = (gradients[0].double() / members[:, None]).to(gradients[0].dtype)
        if not len(shares):
            return shares.new_zeros(len(inverse), 3), None, None, None
        return torch.where((inverse >= 0)[:, None], shares[inverse.clamp(min=0)], 0.0), None, None, None


@op(
    points="N 3",
    ptr="ptr N B",
    voxel_size=checked_edges,
    origin=checked_places,
    min_points=checked_count,
    steps=(voxel_means,),
)
def voxel_downsample(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,)
    *,
    voxel_size: float | Sequence[float] | Sequence[Sequence[float]] | Tensor,
    origin: Any = None,  # (3,) or (B, 3) numbers
    min_points: int = 1,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # means (M, 3) float32, ptr (B+1,), inverse (N,) int64
    """Replace the points of each voxel by their mean; ``inverse[i]`` is the row of ``means`` that point i went into.

    Voxels are ordered by the lowest row they contain. The mean is
    ``origin + (voxel + mean offset) * voxel_size`` with offsets summed in fixed point (2^-31 of a voxel), so neither
    the order of the points nor the device changes a bit of it. The gradient is that of the mean.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        voxel_size: edge length in the unit of the points; one, one per cloud (B,), or per axis too: (1, 3) or (B, 3).
        origin: a corner of a voxel, (3,) or one per cloud (B, 3): grids that share it have the same voxels in every
            cloud. None = half a voxel below the lowest corner of each cloud.
        min_points: voxels with fewer points are left out; ``inverse`` is -1 for their points.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ConfigError: a voxel size that is not positive, or min_points below 1.
        UnitError: an extent of 2^53 voxels or more.
    """
    assert ptr is not None  # @op fills it
    assert isinstance(voxel_size, Tensor)  # and makes it one size per cloud, (B,) or (B, 3)
    edges = voxel_size if voxel_size.ndim == 2 else voxel_size[:, None]
    means, means_ptr, inverse, members = voxel_means(points.detach(), ptr, edges, origin, backend=backend)
    if min_points > 1:
        full = members >= min_points
        inverse = torch.where(full, full.cumsum(0) - 1, -1)[inverse]
        means_ptr, means, members = ptr_after_mask(full, means_ptr), means[full], members[full]
    if torch.is_grad_enabled() and points.requires_grad:
        means = _OfMembers.apply(points, means, inverse, members)  # type: ignore[no-untyped-call]
    return means, means_ptr, inverse


@op(points="N 3", ptr="ptr N B", num_points=checked_count, gradient=False)
def find_voxel_size(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,)
    *,
    num_points: int,
    backend: str = "auto",
) -> Tensor:  # (B,) float64
    """Find, per cloud, the voxel size whose :func:`voxel_downsample` leaves ``num_points``, or as few more as possible.

    The size returned leaves at least ``num_points``; either exactly that many, or a size one part in a million larger
    leaves fewer. (The number of voxels is not monotonic in their size, so a larger size elsewhere may leave as many.)

    Raises:
        TooFewPointsError: a cloud has fewer than ``num_points`` distinct points.
        ConfigError: ``num_points`` is less than 1.
    """
    assert ptr is not None  # @op fills it
    _require_distinct(points, ptr, num_points)
    extent = (segment_max(points, ptr).double() - segment_min(points, ptr)).amax(1)
    too_large = torch.where(extent > 0, 3.0 * extent, 1.0)  # everything lies in one voxel
    if num_points == 1:
        return too_large
    # Bisect, all clouds at once, on a logarithmic scale between a size that leaves enough points and one that leaves
    # too few.
    # Right for a surface, up to a factor. (Torch multiplies by the reciprocal of a number, which rounds twice.)
    enough = extent / torch.full_like(extent, math.sqrt(num_points))
    count = torch.zeros_like(ptr[1:])
    open_ = torch.ones_like(count, dtype=torch.bool)
    while bool(open_.any()):
        count[open_] = _count_voxels(points, ptr, enough, open_)
        open_ &= count < num_points
        too_large = torch.where(open_, enough, too_large)
        enough = torch.where(open_, enough / 2, enough)
    while bool((open_ := (count > num_points) & (too_large > enough * (1 + SIZE_TOLERANCE))).any()):
        middle = square_root(enough * too_large)
        found = count.clone()
        found[open_] = _count_voxels(points, ptr, middle, open_)
        leaves_enough = open_ & (found >= num_points)
        enough = torch.where(leaves_enough, middle, enough)
        count = torch.where(leaves_enough, found, count)
        too_large = torch.where(open_ & ~leaves_enough, middle, too_large)
    return enough


def voxel_cells(
    points: Tensor,  # (N, 3) float32
    voxel_size: float | Sequence[float],
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> Tensor:  # (N, 3) int64
    """Return the integer coordinates of every point's voxel: ``floor((point - origin) / voxel_size)``, in float32.

    What sparse convolutions and their loaders call grid coordinates; :func:`voxel_downsample` works in float64, so a
    point on a face may be counted to another voxel there.

    Args:
        points: in any unit of length.
        voxel_size: edge length, one or one per axis.
        origin: a corner of a voxel.

    Raises:
        ConfigError: a voxel size that is not positive.
    """
    edges = [voxel_size] if isinstance(voxel_size, float) else list(voxel_size)
    if not all(math.isfinite(edge) and edge > 0 for edge in edges):
        raise ConfigError(f"voxel_cells: voxel_size must be positive, got {voxel_size}")
    # A number stays one: torch multiplies by its reciprocal, as in the loaders that this must agree with.
    size = voxel_size if isinstance(voxel_size, float) else points.new_tensor(voxel_size)
    return torch.floor((points - points.new_tensor(origin) if any(origin) else points) / size).long()


def voxel_nearest(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor,  # (B+1,)
    inverse: Tensor,  # (N,) int64, as voxel_downsample returns it, no -1
    num_voxels: int,
    *,
    voxel_size: Tensor,  # (B,) or (B, 3) float64
    origin: Tensor | None = None,  # (B, 3) float64, as voxel_downsample was given
) -> Tensor:  # (M,) int64 rows
    """Return the point nearest to the center of each voxel, the lowest row of equals; N for an empty voxel."""
    edges = voxel_size if voxel_size.ndim == 2 else voxel_size[:, None]
    cloud, _, scaled = _scale_to_grid(points.detach(), ptr, edges, origin)
    offset = (scaled - scaled.floor() - 0.5) * edges[cloud]
    x, y, z = offset.square().unbind(1)
    apart = (x + y) + z
    least = torch.full((num_voxels,), torch.inf, dtype=torch.float64, device=points.device)
    least.scatter_reduce_(0, inverse, apart, "amin")
    nearest = (apart == least[inverse]).nonzero().squeeze(1)
    return torch.cat([nearest, nearest.new_tensor([len(points)])])[group_first(inverse[nearest], num_voxels)]


def _count_voxels(points: Tensor, ptr: Tensor, sizes: Tensor, open_: Tensor) -> Tensor:
    """Return how many points :func:`voxel_downsample` leaves of each open cloud, for (B,) sizes, open_ (B,) bool."""
    if not bool(open_.all()):
        counts = torch.where(open_, counts_from_ptr(ptr), 0)
        points, ptr = points[open_[cloud_of_rows(ptr)]], ptr_from_counts(counts)
    cloud, _, scaled = _scale_to_grid(points, ptr, sizes[:, None])
    return _distinct_per_cloud(cloud, scaled.floor(), len(sizes))[open_]


def _require_distinct(points: Tensor, ptr: Tensor, num_points: int) -> None:
    group, distinct = numbered_rows(points, ptr)
    available = group_count(cloud_of_rows(ptr)[group_first(group, distinct)], len(ptr) - 1)
    for cloud in (available < num_points).nonzero().squeeze(1).tolist():
        raise TooFewPointsError(
            f"find_voxel_size: {num_points} points were asked of cloud {cloud}, which has {int(available[cloud])} "
            "distinct ones; ask for fewer (num_points), or give it more points, as by a wider crop"
        )


def _distinct_per_cloud(cloud: Tensor, voxel: Tensor, num_clouds: int) -> Tensor:
    """Count the different rows of voxel (N, 3, not negative) in each cloud, (B,) int64."""
    rank, distinct = ranked(voxel_keys(cloud, voxel, num_clouds))
    return group_count(cloud[group_first(rank, distinct)], num_clouds)


def _scale_to_grid(
    points: Tensor, ptr: Tensor, edges: Tensor, origin: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return each row's cloud (N,), the grids' origins (B, 3), and the points in voxels from there (N, 3); float64.

    The edges are (B, 1), or (B, 3) where each axis has its own.
    """
    cloud = cloud_of_rows(ptr)
    wide = points.double()
    if origin is None:
        origin = segment_min(wide, ptr) - edges / 2
    scaled = (wide - origin[cloud]) / edges[cloud]
    if len(points) and float(scaled.abs().max()) >= _MAX_VOXELS_PER_AXIS:
        row = int(scaled.abs().amax(1).argmax())
        worst, widest = int(cloud[row]), float(scaled[row].abs().max())
        raise UnitError(
            f"voxel_downsample: cloud {worst} spans {widest:.3g} voxels of {float(edges[worst].min()):g}, more "
            "than 2^53; is the voxel size in the unit of the points, and are there stray points?"
        )
    return cloud, origin, scaled
