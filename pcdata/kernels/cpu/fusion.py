"""Fusion kernels: the blocks that a view touches, averaging the view into them, and the surface within them."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.dispatch import OPERATIONS, kernel
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.tsdf import integrate, marching
from pcdata.functional.tsdf.blocks import MAX_WEIGHT, TSDF_SCALE, VoxelBlocks
from pcdata.functional.tsdf.grid import VoxelGrid
from pcdata.functional.tsdf.surface import Crossings
from pcdata.functional.tsdf.views import FusionView, refuse_labels
from pcdata.geometry.lens_models import is_plain
from pcdata.kernels.cpu.native import Numbers, answers, call, numbers, room, room_for

_FEWEST_SLOTS = 1 << 12  # of a table of rows
_MOST_PIXELS = 2**31 - 1  # of an image: the core numbers them with an int32
_MARKS = 24  # words of a block, a bit for each edge
_PLANES = ("tsdf", "weight", "color", "views", "label", "votes")  # in the order of the core's VoxelPlanes


@kernel("touched_blocks", "cpu")
def touched_blocks(view: FusionView, grid: VoxelGrid) -> Tensor:
    """Collect keys in one hash table per thread; sorted, they do not depend on the threads."""
    height, width = view.depth.shape
    offsets = integrate.band(grid)
    found = room(height * width * len(offsets), torch.int64)  # what is not written never becomes memory
    count = answers()
    turn, fraction, camera = integrate.camera_in_blocks(view, grid)
    images = (view.depth.contiguous(), view.rays.contiguous(), height, width)
    call("pc_tsdf_touched", *images, turn, fraction, camera, offsets, len(offsets), found, count)
    if count[0] < 0:
        keys: Tensor = OPERATIONS["touched_blocks"].reference(view, grid)  # knows what to say
        return keys
    return torch.from_numpy(found[: count[0]].numpy().copy())


@kernel("locate_views", "cpu")
def locate_views(blocks: VoxelBlocks, views: Sequence[FusionView], grid: VoxelGrid) -> tuple[list[Tensor], Tensor]:
    """Take one view after another, each with all threads."""
    refuse_labels(any(view.unfit is not None and bool(view.unfit) for view in views))
    touched = [touched_blocks(view, grid) for view in views]
    return integrate.located(blocks, touched, [find_blocks(blocks, keys) for keys in touched])


@kernel("pack_colors", "cpu")
def pack_colors(colors: Tensor) -> Tensor:
    """Pack pixels on this thread: torch's threads would spin where the next steps want to work."""
    packed = room(colors.shape[:-1], torch.int32)
    call("pc_tsdf_pack_colors", colors, packed.numel(), packed)
    return packed


@kernel("find_blocks", "cpu")
def find_blocks(blocks: VoxelBlocks, keys: Tensor) -> tuple[Tensor, Tensor]:
    """Ask a hash table of the rows, which learns here of the blocks added since the last time."""
    if blocks.table is None or 2 * len(blocks) > len(blocks.table):
        slots = blocks.table_size(_FEWEST_SLOTS)
        blocks.table, blocks.in_table = torch.from_numpy(np.full(slots, -1, np.int32)), 0
    rows, missing, count = room(keys.shape, torch.int64), room(keys.shape, torch.int64), answers()
    table = (blocks.keys, len(blocks), blocks.table, len(blocks.table), blocks.in_table)
    call("pc_tsdf_find", *table, keys, len(keys), rows, missing, count)
    blocks.in_table = len(blocks)
    return rows, missing[: count[0]]


@kernel("integrate_view", "cpu")
def integrate_view(blocks: VoxelBlocks, rows: Tensor, view: FusionView, grid: VoxelGrid, *, carve: bool) -> None:
    """Update every block on its own, 4, 8 or 16 voxels at a time."""
    if view.depth.numel() > _MOST_PIXELS or not is_plain(view.distortion):
        OPERATIONS["integrate_view"].reference(blocks, rows, view, grid, carve=carve)
        return
    lens = None
    if view.distortion is not None:
        lens = torch.cat([view.distortion.float(), view.depth.new_tensor([view.fold])])
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
        view.depth.new_tensor(view.pinhole),
        lens,
        float(np.float32(TSDF_SCALE / grid.truncation)),
        int(carve),
        rows,
        len(rows),
        blocks.keys,
        planes,
    )
    del kept  # until here the addresses are good


@kernel("find_crossings", "cpu")
def find_crossings(blocks: VoxelBlocks, grid: VoxelGrid, *, min_weight: int, edges: bool) -> Crossings:
    """Count the edges of every block that cross zero, then write their points where they belong."""
    count = len(blocks)
    planes, kept = plane_addresses(blocks)
    field = (blocks.sorted_keys, blocks.sorted_rows, count, planes)
    counts, dropped = room(count, torch.int64), answers()
    (marks,) = room_for(((count, _MARKS), torch.int64))
    call("pc_tsdf_count_crossings", *field, min(min_weight - 1, MAX_WEIGHT), counts, marks, dropped)
    starts = ptr_from_counts(counts)
    found = _room_for_crossings(int(starts[-1]), dropped[0], blocks, edges)
    columns = (found.points, found.normals, found.weight, found.views, found.colors, found.labels)
    edge = found.edge if edges else None
    call("pc_tsdf_write_crossings", *field, marks, starts, grid.voxel_size, edge, *columns)
    del kept  # until here the addresses are good
    return found


def _room_for_crossings(total: int, dropped: int, blocks: VoxelBlocks, edges: bool) -> Crossings:
    triples = ((total, 3), torch.float32)
    number = ((total,), torch.int64)
    edge, points, normals, weight, views, colors, labels = room_for(
        number if edges else ((0,), torch.int64),
        triples,
        triples,
        ((total,), torch.float32),
        number,
        triples if "color" in blocks.planes else ((0,), torch.float32),
        number if "label" in blocks.planes else ((0,), torch.int64),
    )
    return Crossings(
        edge=edge,
        points=points,
        normals=normals,
        weight=weight,
        views=views,
        colors=colors if "color" in blocks.planes else None,
        labels=labels if "label" in blocks.planes else None,
        dropped=dropped,
    )


@kernel("find_triangles", "cpu")
def find_triangles(blocks: VoxelBlocks, edge: Tensor, *, min_weight: int) -> tuple[Tensor, Tensor]:
    """Pack the signs of every block into words, count its triangles, write them, and number the vertices in use."""
    count, keys = len(blocks), blocks.sorted_keys
    planes, kept = plane_addresses(blocks)
    signs, edges = room((count, 16), torch.int64), room((count, 32), torch.int64)
    bound = min(min_weight - 1, MAX_WEIGHT)
    call("pc_tsdf_index_mesh", keys, blocks.sorted_rows, count, planes, bound, edge, len(edge), signs, edges)
    del kept  # until here the addresses are good
    first, corner, axis = marching.tensor_tables(edge.device)
    mesh = (keys, count, signs, edges, first, 3 * corner + axis)
    counts, is_used = room(count, torch.int64), torch.zeros(len(edge), dtype=torch.bool, device="cpu")
    call("pc_tsdf_count_triangles", *mesh, counts)
    starts = ptr_from_counts(counts)
    (triangles,) = room_for(((int(starts[-1]), 3), torch.int64))
    call("pc_tsdf_write_triangles", *mesh, starts, triangles, is_used)
    call("pc_tsdf_renumber", triangles, triangles.numel(), is_used.cumsum(0) - 1)
    return is_used.nonzero().squeeze(1), triangles


def plane_addresses(blocks: VoxelBlocks) -> tuple[Numbers, list[Numbers]]:
    """Return the core's table of planes, (6,) addresses of arrays of chunk addresses, and what keeps these alive."""
    kept, table = [], answers(len(_PLANES))
    for place, name in enumerate(_PLANES):
        if blocks.chunks and name in blocks.planes:
            # Views: the core knows the layout of a chunk.
            kept.append(numbers(chunk[name].data_ptr() for chunk in blocks.chunks))
            table[place] = ctypes.addressof(kept[-1])
    return table, kept
