"""The grid of a truncated signed distance field: where its samples lie, and the keys of blocks of 8 x 8 x 8 of them.

Samples (voxels) lie at whole multiples of the voxel size, so volumes of one voxel size share one grid, wherever they
begin. Block (i, j, k) holds voxels 8i..8i+7 along x and so on; voxel (x, y, z) of a block is number ``64 z + 8 y + x``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.contracts.fields import Fields
from pcdata.errors import ConfigError, UnitError

EDGE = 8  # voxels along a block's edge
VOXELS = EDGE**3
_BITS = 21  # per axis of a key
BLOCKS_PER_SIDE = 1 << (_BITS - 1)  # on either side of the origin
_LOW = (1 << _BITS) - 1


@dataclass(frozen=True)
class VoxelGrid:
    """The lengths of a field, in metres."""

    voxel_size: float
    truncation: float  # distances beyond it are not kept

    def __post_init__(self) -> None:
        if not (math.isfinite(self.voxel_size) and self.voxel_size > 0):
            raise ConfigError(f"VoxelGrid: voxel_size must be positive metres, got {self.voxel_size}")
        # Under two voxels an edge across a slanted surface misses one end; over 64 a block would hold no surface.
        if not 2 * self.voxel_size <= self.truncation <= 64 * self.voxel_size:
            raise ConfigError(
                f"VoxelGrid: truncation must be 2 to 64 voxels, {2 * self.voxel_size:g} to {64 * self.voxel_size:g} m, "
                f"got {self.truncation:g}"
            )

    @property
    def block_size(self) -> float:
        """Edge length of a block in metres."""
        return EDGE * self.voxel_size

    @property
    def band(self) -> list[float]:
        """Offsets from a reading along its ray, in metres of depth, at which blocks are opened: half a block apart."""
        halves = max(1, math.ceil(self.truncation / (self.block_size / 2)))
        return [self.truncation * step / halves for step in range(-halves, halves + 1)]


GRID = Fields(VoxelGrid)  # the spec of a grid


def pack_keys(blocks: Tensor) -> Tensor:
    """Number blocks (N, 3) int64 by (N,) int64 keys, which sort as x, then y, then z.

    Raises:
        UnitError: a block more than 2^20 blocks from the origin.
    """
    if len(blocks) and int(blocks.abs().max()) >= BLOCKS_PER_SIDE:
        raise UnitError(
            f"TSDF: a reading lies {int(blocks.abs().max()):.3g} blocks from the origin, more than 2^20; are depth, "
            "pose and voxel size in metres?"
        )
    x, y, z = (blocks + BLOCKS_PER_SIDE).unbind(-1)
    return (x << 2 * _BITS) | (y << _BITS) | z


def unpack_keys(keys: Tensor) -> Tensor:
    """Return the blocks (N, 3) int64 of keys (N,)."""
    return torch.stack([keys >> 2 * _BITS, (keys >> _BITS) & _LOW, keys & _LOW], dim=-1) - BLOCKS_PER_SIDE


def voxel_offsets(device: torch.device | str = "cpu") -> Tensor:
    """Return (512, 3) int64: x, y, z of every voxel within its block."""
    number = torch.arange(VOXELS, dtype=torch.int64, device=device)
    return torch.stack([number % EDGE, number // EDGE % EDGE, number // EDGE**2], dim=-1)
