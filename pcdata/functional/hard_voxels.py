"""Tables of voxels of a stated size, as detectors on lidar points take them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count, checked_edges, checked_places
from pcdata.contracts.on_host import on_host, uploaded
from pcdata.errors import ConfigError
from pcdata.functional.equal_rows import numbered_in_order, voxel_keys
from pcdata.functional.rows import cloud_of_rows, group_count, ptr_from_counts


class HardVoxels(NamedTuple):
    """Voxels of all clouds, one after another."""

    point_index: Tensor  # (M, max_points) int64 rows of the points, their number where there are fewer
    cell: Tensor  # (M, 3) int64 x, y, z of the voxel, from the lower corner
    num_points: Tensor  # (M,) int64 of them in the table
    ptr: Tensor  # (B+1,)


@op(
    points="N 3",
    ptr="ptr N B",
    voxel_size=checked_edges,
    lower=checked_places,
    upper=checked_places,
    max_points=checked_count,
    max_voxels=checked_count,
    gradient=False,
)
def hard_voxels(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    voxel_size: float | Sequence[float] | Sequence[Sequence[float]] | Tensor,
    lower: Any,  # (3,) or (B, 3) numbers
    upper: Any,
    max_points: int = 32,
    max_voxels: int = 20000,
    backend: str = "auto",
) -> HardVoxels:
    """Put the points of each cloud into a table of at most ``max_voxels`` voxels of at most ``max_points`` rows.

    Voxels come in the order of their first points, and within them points in their own order; what is more is left
    out. The grid has round((upper - lower) / voxel_size) voxels along each axis; a point's is
    floor((point - lower) / voxel_size) in float32, and points of none are left out. :func:`voxel_downsample` gives all
    voxels with all points instead.

    Features follow by their rows: ``torch.cat([features, zeros])[found.point_index]`` is (M, max_points, C), as
    MMDetection3D and spconv have it; their coordinates are ``found.cell.flip(1)``, z first.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        voxel_size: edge length; one, one per cloud (B,), or per axis too: (1, 3) or (B, 3).
        lower: the corner where the grid begins, (3,) or one per cloud (B, 3).
        upper: the corner where it ends, likewise.
        max_points: rows of a voxel.
        max_voxels: voxels of a cloud.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ConfigError: a parameter out of range, or a grid without a voxel.

    Source: Zhou & Tuzel, VoxelNet, CVPR 2018, section 2.1.1, with the first points instead of random ones.
    """
    assert ptr is not None  # @op fills it
    assert isinstance(voxel_size, Tensor)  # and makes it (B,) or (B, 3)
    low, high, sides = (on_host(one).float() for one in (lower, upper, voxel_size))
    sides = sides if sides.ndim == 2 else sides[:, None].expand(-1, 3)
    edges = voxel_size if voxel_size.ndim == 2 else voxel_size[:, None].expand(-1, 3)
    shape = ((high - low) / sides).round().long()
    for b in (shape < 1).any(1).nonzero().squeeze(1).tolist():
        raise ConfigError(
            f"hard_voxels: the grid of cloud {b} has no voxel: lower {lower[b].tolist()}, upper {upper[b].tolist()}, "
            f"voxel_size {edges[b].tolist()}"
        )
    shape = uploaded(shape, points.device)
    cloud = cloud_of_rows(ptr)
    place = ((points - lower.float()[cloud]) / edges.float()[cloud]).floor()
    row = ((place >= 0) & (place < shape[cloud])).all(1).nonzero().squeeze(1)
    owner, cell = cloud[row], place[row].long()
    voxel, first = numbered_in_order(voxel_keys(owner, cell, len(ptr) - 1))
    # The number of each voxel among those of its cloud; rows of clouds follow one another, so voxels do too.
    counts = group_count(owner[first], len(ptr) - 1)
    number = (
        torch.arange(len(first), dtype=torch.int64, device=points.device) - (counts.cumsum(0) - counts)[owner[first]]
    )
    kept = number < max_voxels
    new = kept.cumsum(0) - 1
    order = voxel.argsort(stable=True)
    sizes = group_count(voxel, len(first))
    rank = torch.arange(len(row), dtype=torch.int64, device=points.device) - (sizes.cumsum(0) - sizes)[voxel[order]]
    taken = (rank < max_points) & kept[voxel[order]]
    table = torch.full((int(kept.sum()), max_points), len(points), dtype=torch.int64, device=points.device)
    table[new[voxel[order]][taken], rank[taken]] = row[order][taken]
    found = ptr_from_counts(counts.clamp(max=max_voxels))
    return HardVoxels(table, cell[first][kept], sizes[kept].clamp(max=max_points), found)
