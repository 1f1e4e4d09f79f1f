"""Views go into a field on a GPU: the blocks that they touch, and averaging them into these.

The host waits for how many blocks there are, once for all views of a capture, and for nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.dispatch import OPERATIONS, kernel
from pcdata.functional.tsdf import integrate
from pcdata.functional.tsdf.blocks import TSDF_SCALE, VoxelBlocks
from pcdata.functional.tsdf.grid import VOXELS, VoxelGrid
from pcdata.functional.tsdf.views import FusionView, refuse_labels
from pcdata.geometry.lens_models import is_plain
from pcdata.kernels.cuda.launching import launcher_of
from pcdata.kernels.cuda.view_numbers import OF_VOXELS, numbers_of
from pcdata.kernels.cuda.voxel_tables import planes_of, row_table, touched_keys

_TOGETHER = 4  # voxels of a thread, kTogether of the kernel


@kernel("touched_blocks", "cuda")
def touched_blocks(view: FusionView, grid: VoxelGrid) -> Tensor:
    """Collect keys in a hash table; the one wait is for their number."""
    found = touched_keys(None, [view], grid)
    if found is None:
        keys: Tensor = OPERATIONS["touched_blocks"].reference(view, grid)  # knows what to say
        return keys
    return found.touched[0]


@kernel("locate_views", "cuda")
def locate_views(blocks: VoxelBlocks, views: Sequence[FusionView], grid: VoxelGrid) -> tuple[list[Tensor], Tensor]:
    """Touch with all views, then wait once, for the numbers of blocks."""
    found = touched_keys(blocks, views, grid)
    if found is None:
        fallen: tuple[list[Tensor], Tensor] = OPERATIONS["locate_views"].reference(blocks, views, grid)
        return fallen
    refuse_labels(found.is_unfit)
    rows = [_rows_of(blocks, keys) for keys in found.touched]
    return [integrate.with_new_rows(blocks, *pair, found.missing) for pair in zip(rows, found.touched)], found.missing


@kernel("find_blocks", "cuda")
def find_blocks(blocks: VoxelBlocks, keys: Tensor) -> tuple[Tensor, Tensor]:
    """Ask a hash table of the rows, which learns here of the blocks added since the last time."""
    rows = _rows_of(blocks, keys)
    return rows, keys[rows < 0]


@kernel("pack_colors", "cuda")
def pack_colors(colors: Tensor) -> Tensor:
    """Pack all pixels in one kernel."""
    packed = torch.empty(colors.shape[:-1], dtype=torch.int32, device=colors.device)
    launcher_of(colors).launch("pc_pack_colors", packed.numel(), colors, packed.numel(), packed)
    return packed


@kernel("integrate_view", "cuda")
def integrate_view(blocks: VoxelBlocks, rows: Tensor, view: FusionView, grid: VoxelGrid, *, carve: bool) -> None:
    """Update four voxels a thread; nothing waits for the device."""
    if not is_plain(view.distortion):
        OPERATIONS["integrate_view"].reference(blocks, rows, view, grid, carve=carve)
        return
    launcher, (height, width) = launcher_of(view.depth), view.depth.shape
    images = [None if one is None else one.contiguous() for one in (view.weight, view.color, view.label)]
    launcher.launch(
        "pc_integrate_view",
        len(rows) * (VOXELS // _TOGETHER),
        *(view.depth.contiguous(), *images, height, width),
        *(numbers_of(view, grid)[OF_VOXELS], int(view.distortion is not None), grid.block_size),
        *(float(np.float32(TSDF_SCALE / grid.truncation)), int(carve), rows, len(rows), blocks.keys),
        *planes_of(launcher, blocks),
    )


def _rows_of(blocks: VoxelBlocks, keys: Tensor) -> Tensor:
    """Return the rows (N,) int64 of keys, -1 where there is none."""
    rows, launcher = torch.empty_like(keys), launcher_of(keys)
    launcher.launch("pc_find_blocks", len(keys), *row_table(launcher, blocks), keys, len(keys), rows)
    return rows
