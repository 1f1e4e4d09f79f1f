"""One point per voxel, kept as it is: VoxelSample, RandomVoxelSample."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pcdata.functional.rows import cloud_of_rows, ptr_from_counts
from pcdata.rng import Streams, seeded
from pcdata.structures import PointCloud
from pcdata.transforms.families import SelectTransform
from pcdata.transforms.field_types import Positive, Unit


def voxel_cells(points: Tensor, voxel_size: float) -> Tensor:
    """Return the (N, 3) int64 cells ``floor(x / voxel_size)`` of a grid through the origin."""
    return torch.floor(points / voxel_size).long()


class VoxelSample(SelectTransform):
    """Keep the first point of every occupied voxel of a grid through the origin; nothing is averaged.

    Args:
        voxel_size: edge length, in `unit`.
        unit: of voxel_size; a cloud in another one is refused.
    """

    voxel_size: Positive
    unit: Unit = "m"

    def unit_needed(self) -> str:
        """The unit of the voxel size."""
        return self.unit

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Pick the row with the lowest rank in each voxel; rows of the result are in their old order."""
        owner = cloud_of_rows(cloud.ptr)
        voxel = _numbered(torch.cat([owner[:, None], voxel_cells(cloud.points, self.voxel_size)], dim=1))
        rank = self.ranks(cloud, streams)
        count = int(voxel.max()) + 1 if len(voxel) else 0
        best = torch.full((count,), cloud.num_points, dtype=torch.int64, device=cloud.device)
        best.scatter_reduce_(0, voxel, rank, "amin")
        mask = rank == best[voxel]
        counts = torch.bincount(owner[mask], minlength=cloud.num_clouds)
        return mask, ptr_from_counts(counts)

    def ranks(self, cloud: PointCloud, streams: Streams) -> Tensor:
        """(N,) int64: of the points in one voxel the lowest stays; distinct within a cloud."""
        return torch.arange(cloud.num_points, dtype=torch.int64, device=cloud.device)


class RandomVoxelSample(VoxelSample):
    """Keep a random point of every occupied voxel of a grid through the origin (Pointcept's GridSample in training)."""

    is_random = True

    def ranks(self, cloud: PointCloud, streams: Streams) -> Tensor:
        """A random order of the points of each cloud."""
        counts = cloud.counts.tolist()
        orders = [
            torch.randperm(count, generator=seeded(seed), device="cpu")
            for count, seed in zip(counts, streams.seeds().tolist())
        ]
        return torch.cat(orders).to(cloud.device)


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
