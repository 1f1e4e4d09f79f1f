"""One point per voxel, kept as it is: VoxelSample, RandomVoxelSample."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from pcdata.contracts.on_host import uploaded
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts
from pcdata.functional.voxels import voxel_cells
from pcdata.rng import Streams, words
from pcdata.structures import PointCloud
from pcdata.transforms.families import SelectTransform
from pcdata.transforms.field_types import Count, Positive, Unit, Vec3


class _OnePerVoxel(SelectTransform, abstract=True):
    """A step that keeps one point of every occupied voxel; nothing is averaged.

    Args:
        voxel_size: edge length, in `unit`; one, or one per axis.
        unit: of voxel_size and origin; a cloud in another one is refused.
        origin: a corner of a voxel.
        min_points: voxels with fewer points lose them all.
    """

    voxel_size: Positive | tuple[Positive, Positive, Positive]
    unit: Unit = "m"
    origin: Vec3 = (0.0, 0.0, 0.0)
    min_points: Count = 1

    def unit_needed(self) -> str:
        """The unit of the voxel size."""
        return self.unit

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Pick the row with the lowest rank in each voxel; rows of the result are in their old order."""
        owner = cloud_of_rows(cloud.ptr)
        cells = voxel_cells(cloud.points, self.voxel_size, self.origin)
        voxel = _numbered(torch.cat([owner[:, None], cells], dim=1))
        rank = self.ranks(cloud, streams)
        count = int(voxel.max()) + 1 if len(voxel) else 0
        best = torch.full((count,), torch.iinfo(torch.int64).max, dtype=torch.int64, device=cloud.device)
        best.scatter_reduce_(0, voxel, rank, "amin")
        mask = rank == best[voxel]
        if self.min_points > 1:
            mask &= (torch.bincount(voxel, minlength=count) >= self.min_points)[voxel]
        counts = torch.bincount(owner[mask], minlength=cloud.num_clouds)
        return mask, ptr_from_counts(counts)

    def ranks(self, cloud: PointCloud, streams: Streams) -> Tensor:
        """(N,) int64: of the points in one voxel the lowest stays; distinct within a cloud."""
        raise NotImplementedError


class VoxelSample(_OnePerVoxel):
    """Keep one point of every occupied voxel of a stated grid, as it is.

    Args:
        keep: which one: the first of the rows, or the nearest to the center of the voxel.
    """

    keep: Literal["first", "nearest"] = "first"

    def ranks(self, cloud: PointCloud, streams: Streams) -> Tensor:
        """The order of the rows, or of their distances to the centers of their voxels."""
        rows = torch.arange(cloud.num_points, dtype=torch.int64, device=cloud.device)
        if self.keep == "first":
            return rows
        size = cloud.points.new_tensor(self.voxel_size)
        cells = voxel_cells(cloud.points, self.voxel_size, self.origin)
        offset = cloud.points - cloud.points.new_tensor(self.origin) - (cells + 0.5) * size
        x, y, z = offset.square().unbind(1)
        return torch.empty_like(rows).scatter_(0, ((x + y) + z).argsort(stable=True), rows)


class RandomVoxelSample(_OnePerVoxel):
    """Keep a random point of every occupied voxel of a stated grid (Pointcept's GridSample in training)."""

    is_random = True
    version = 2

    def ranks(self, cloud: PointCloud, streams: Streams) -> Tensor:
        """The words of each cloud's seed, of which no two are equal."""
        seeds, ptr = uploaded(streams.seeds(), cloud.device), cloud.ptr
        owner = cloud_of_rows(ptr)
        row = torch.arange(cloud.num_points, dtype=torch.int64, device=cloud.device) - ptr[owner]
        return words(seeds[owner], row)


def _numbered(cells: Tensor) -> Tensor:
    """Number the different rows of (N, 4) from 0: (N,) int64."""
    if len(cells) == 0:
        return cells[:, 0]
    cells = cells - cells.amin(dim=0)
    sizes = (cells.amax(dim=0) + 1).tolist()
    if math.prod(sizes) >= 2**62:  # a grid too large to number its cells: compare the rows themselves
        return torch.unique(cells, dim=0, return_inverse=True)[1]
    key = cells[:, 0]
    for column, size in zip(cells[:, 1:].unbind(1), sizes[1:]):
        key = key * size + column
    return torch.unique(key, return_inverse=True)[1]
