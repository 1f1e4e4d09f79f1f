"""What the kernels of fusion look up: the table of blocks, the addresses of their voxels, and what views touch."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.on_host import uploaded
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.tsdf.blocks import VoxelBlocks
from pcdata.functional.tsdf.grid import VoxelGrid
from pcdata.functional.tsdf.views import FusionView
from pcdata.kernels.cuda.launching import Launcher, launcher_of
from pcdata.kernels.cuda.view_numbers import OF_RAYS, numbers_of

_FEWEST_PLACES = 1 << 12  # of a table
_PLANES = {"color": 1, "views": 2, "label": 4}  # bits of VoxelPlanes
_TILE_WIDTH, _TILE_HEIGHT = 32, 8  # pixels, kTileWidth and kTileHeight
_PROBES = 64  # in a table that may be too small
_GROWTH = 8
_COUNTERS = 4  # before those of each view


def row_table(launcher: Launcher, blocks: VoxelBlocks) -> tuple[Any, ...]:
    """Return the table of all rows as kernels take it, once the blocks added since the last time are in it."""
    count = len(blocks)
    if count == 0:
        return None, None, 0, 0
    if blocks.table is None or 2 * count > len(blocks.table):
        size = blocks.table_size(_FEWEST_PLACES)
        blocks.table, blocks.in_table = torch.full((size,), -1, dtype=torch.int32, device=blocks.device), 0
    size = len(blocks.table)
    table = blocks.keys, blocks.table, size - 1, 65 - size.bit_length()
    launcher.launch("pc_add_blocks", count - blocks.in_table, *table, blocks.in_table, count)
    blocks.in_table = count
    return table


def planes_of(launcher: Launcher, blocks: VoxelBlocks) -> tuple[Tensor, int]:
    """Return the addresses of all chunks, on the device, and which planes there are."""
    if blocks.addresses is None or len(blocks.addresses) < len(blocks.chunks):
        addresses = [launcher.address(chunk["tsdf"]) for chunk in blocks.chunks]  # the first plane
        blocks.addresses = uploaded(torch.tensor(addresses, dtype=torch.int64, device="cpu"), blocks.device)
    return blocks.addresses, sum(bit for name, bit in _PLANES.items() if name in blocks.planes)


class Touched(NamedTuple):
    """What views touch."""

    touched: list[Tensor]  # of every view the sorted keys (N,) of its blocks
    missing: Tensor  # (M,) sorted keys of those that have no row
    is_unfit: bool  # whether a label does not fit


def touched_keys(blocks: VoxelBlocks | None, views: Sequence[FusionView], grid: VoxelGrid) -> Touched | None:
    """Look up the blocks along all rays; None if one lies out of reach. The host waits for their numbers.

    The table of what is touched is made for what views touch as a rule; where that is too small, a larger one is tried.
    """
    launcher, device = launcher_of(views[0].depth), views[0].depth.device
    halves = len(grid.band) // 2
    most = sum(view.depth.numel() for view in views) * (2 * halves + 1)
    size = _power_of_two(most // 8)
    known = (None, None, 0, 0) if blocks is None else row_table(launcher, blocks)
    numbers = [numbers_of(view, grid)[OF_RAYS] for view in views]
    while True:
        room = torch.zeros(size + size // 2 + _COUNTERS + 2 * len(views), dtype=torch.int64, device=device)
        places, stamps = room[:size], room[size:].view(torch.int32)
        counters = stamps[size:]
        touched, missing = torch.empty((2, size), dtype=torch.int64, device=device).unbind()
        probes = _PROBES if size < 2 * most else size
        for number, view in enumerate(views):
            height, width = view.depth.shape
            launcher.launch_blocks(
                "pc_touch_blocks",
                -(-width // _TILE_WIDTH) * -(-height // _TILE_HEIGHT),
                *(view.depth.contiguous(), view.rays.contiguous(), height, width),
                *(numbers[number], grid.truncation, halves, number),
                *(places, stamps, size - 1, probes, *known, touched, missing, counters),
                block=_TILE_WIDTH * _TILE_HEIGHT,
            )
            if view.unfit is not None:
                counters[_COUNTERS + len(views) + number].copy_(view.unfit[0])
        far, is_full, num_missing, _, *of_views = counters[: _COUNTERS + 2 * len(views)].tolist()
        if far:
            return None
        if not is_full:
            ends = itertools.pairwise(ptr_from_counts(of_views[: len(views)]).tolist())
            parts = [touched[start:end].sort().values for start, end in ends]
            return Touched(parts, missing[:num_missing].sort().values, any(of_views[len(views) :]))
        size *= _GROWTH


def _power_of_two(least: int) -> int:
    return max(_FEWEST_PLACES, 1 << (least - 1).bit_length())
