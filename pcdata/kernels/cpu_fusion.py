"""Fusion kernels: the blocks that a view touches, averaging the view into them, and the surface within them."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import torch
from torch import Tensor

from pcdata.functional.ragged import ptr_from_counts
from pcdata.functional.tsdf import integrate
from pcdata.functional.tsdf.backends import BODIES
from pcdata.functional.tsdf.blocks import TSDF_SCALE, VoxelBlocks
from pcdata.functional.tsdf.grid import VoxelGrid
from pcdata.functional.tsdf.surface import Crossings
from pcdata.functional.tsdf.views import FusionView
from pcdata.kernels.native import call

_MARK_BYTES = 192  # per block: a bit per edge
_FEWEST_SLOTS = 1 << 12  # of a table of rows
_PLANES = ("tsdf", "weight", "color", "views", "label", "votes")  # in the order of the core's VoxelPlanes


def touched_blocks(view: FusionView, grid: VoxelGrid) -> Tensor:
    """Collect keys in one hash table per thread; sorted, they do not depend on the threads."""
    height, width = view.depth.shape
    offsets = integrate.band(grid)
    found = torch.empty(height * width * len(offsets), dtype=torch.int64)  # what is not written never becomes memory
    count = torch.empty(1, dtype=torch.int64)
    turn, fraction, camera = integrate.camera_in_blocks(view, grid)
    images = (view.depth.contiguous(), view.rays.contiguous(), height, width)
    call("pc_tsdf_touched", *images, turn, fraction, camera, offsets, len(offsets), found, count)
    if count < 0:
        return integrate.touched_blocks(view, grid)  # knows what to say
    return torch.from_numpy(found[: int(count)].numpy().copy())


def pack_colors(colors: Tensor) -> Tensor:
    """Pack pixels on this thread: torch's threads would spin where the next steps want to work."""
    packed = torch.empty(colors.shape[:-1], dtype=torch.int32)
    call("pc_tsdf_pack_colors", colors.contiguous(), packed.numel(), packed)
    return packed


def find_blocks(blocks: VoxelBlocks, keys: Tensor) -> tuple[Tensor, Tensor]:
    """Ask a hash table of the rows, which learns here of the blocks added since the last time."""
    if blocks.table is None or 2 * len(blocks) > len(blocks.table):
        slots = max(_FEWEST_SLOTS, 1 << (4 * len(blocks) - 1).bit_length())
        blocks.table, blocks.in_table = torch.from_numpy(np.full(slots, -1, np.int32)), 0
    rows, missing, count = torch.empty_like(keys), torch.empty_like(keys), torch.empty(1, dtype=torch.int64)
    table = (blocks.keys, len(blocks), blocks.table, len(blocks.table), blocks.in_table)
    call("pc_tsdf_find", *table, keys.contiguous(), len(keys), rows, missing, count)
    blocks.in_table = len(blocks)
    return rows, missing[: int(count)]


def integrate_view(blocks: VoxelBlocks, rows: Tensor, view: FusionView, grid: VoxelGrid, *, carve: bool) -> None:
    """Update every block on its own, 4, 8 or 16 voxels at a time."""
    lens = None
    if view.distortion is not None:
        lens = torch.cat([view.distortion.float(), torch.tensor([view.fold], dtype=torch.float32)])
    height, width = view.depth.shape
    planes, kept = plane_addresses(blocks)
    images = [None if one is None else one.contiguous() for one in (view.weight, view.color, view.label)]
    call(
        "pc_tsdf_integrate",
        view.depth.contiguous(),
        *images,
        height,
        width,
        integrate.image_from_world(view).contiguous(),
        grid.block_size,
        integrate.voxel_steps(view, grid).contiguous(),
        torch.tensor(view.pinhole, dtype=torch.float32),
        lens,
        float(torch.tensor(TSDF_SCALE / grid.truncation, dtype=torch.float32)),
        int(carve),
        rows,
        len(rows),
        blocks.keys,
        planes,
    )
    del kept  # until here the addresses are good


def find_crossings(blocks: VoxelBlocks, grid: VoxelGrid) -> Crossings:
    """Mark the edges that cross zero, then write every block's points where they belong."""
    count = len(blocks)
    planes, kept = plane_addresses(blocks)
    field = (blocks.sorted_keys, blocks.sorted_rows, count, planes)
    marks, counts = torch.empty((count, _MARK_BYTES), dtype=torch.uint8), torch.empty(count, dtype=torch.int64)
    call("pc_tsdf_mark", *field, marks, counts)
    starts = ptr_from_counts(counts)
    total = int(starts[-1])
    found = Crossings(
        edge=torch.empty(total, dtype=torch.int64),
        points=torch.empty((total, 3)),
        normals=torch.empty((total, 3)),
        weight=torch.empty(total, dtype=torch.int32),
        views=torch.empty(total, dtype=torch.int32),
        colors=torch.empty((total, 3)) if blocks.planes.colors else None,
        labels=torch.empty(total, dtype=torch.int64) if blocks.planes.labels else None,
    )
    call("pc_tsdf_points", *field, marks, starts, grid.voxel_size, *(getattr(found, f.name) for f in fields(found)))
    del kept  # until here the addresses are good
    return found


def plane_addresses(blocks: VoxelBlocks) -> tuple[Tensor, list[Tensor]]:
    """Return the core's table of planes, (6,) addresses of arrays of chunk addresses, and what keeps these alive."""
    kept = []
    table = torch.zeros(len(_PLANES), dtype=torch.int64)
    for place, name in enumerate(_PLANES):
        chunks = [getattr(chunk, name) for chunk in blocks.chunks]
        if chunks and chunks[0] is not None:
            kept.append(torch.tensor([plane.data_ptr() for plane in chunks], dtype=torch.int64))
            table[place] = kept[-1].data_ptr()
    return table, kept


BODIES["pack_colors", "cpu"] = pack_colors
BODIES["find_blocks", "cpu"] = find_blocks
BODIES["touched_blocks", "cpu"] = touched_blocks
BODIES["integrate_view", "cpu"] = integrate_view
BODIES["find_crossings", "cpu"] = find_crossings
