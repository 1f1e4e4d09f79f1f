"""Surfaces out of a field on a GPU: its zero crossings, and the triangles between them.

A block of threads looks at a block of voxels, once to count and once to write. The host waits for how many there are.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.dispatch import kernel
from pcdata.functional.tsdf import marching
from pcdata.functional.tsdf.blocks import MAX_WEIGHT, VoxelBlocks
from pcdata.functional.tsdf.grid import VOXELS, VoxelGrid
from pcdata.functional.tsdf.surface import Crossings
from pcdata.kernels.cuda.launching import launcher_of
from pcdata.kernels.cuda.voxel_tables import planes_of, row_table

_WARP = 32
_GROUPS = VOXELS // _WARP  # of 32 voxels, a bit of a word each


@kernel("find_crossings", "cuda")
def find_crossings(blocks: VoxelBlocks, grid: VoxelGrid, *, min_weight: int, edges: bool) -> Crossings:
    """Mark the edges of every block that cross zero, then write their points where they belong."""
    count, device = len(blocks), blocks.device
    launcher = launcher_of(blocks.keys)
    field = blocks.sorted_keys, blocks.sorted_rows, *row_table(launcher, blocks), *planes_of(launcher, blocks)
    marks = torch.empty((count, 3 * _GROUPS), dtype=torch.int32, device=device)
    counts = torch.zeros(count + 1, dtype=torch.int64, device=device)
    dropped = torch.zeros(1, dtype=torch.int64, device=device)
    bound = min(min_weight - 1, MAX_WEIGHT)
    launcher.launch_blocks("pc_mark_crossings", count, *field, bound, marks, counts[1:], dropped)
    starts = counts.cumsum(0)
    total, num_dropped = torch.cat([starts[-1:], dropped]).tolist()
    found = _room_for_crossings(total, num_dropped, blocks, edges)
    columns = found.points, found.normals, found.weight, found.views, found.colors, found.labels
    edge = found.edge if edges else None
    if total:
        launcher.launch_blocks(
            "pc_write_crossings", count, *field, marks, starts, grid.voxel_size, edge, *columns, block=4 * _WARP
        )
    return found


def _room_for_crossings(total: int, dropped: int, blocks: VoxelBlocks, edges: bool) -> Crossings:
    def room(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=blocks.device)

    return Crossings(
        edge=room(total if edges else 0, dtype=torch.int64),
        points=room(total, 3),
        normals=room(total, 3),
        weight=room(total),
        views=room(total, dtype=torch.int64),
        colors=room(total, 3) if "color" in blocks.planes else None,
        labels=room(total, dtype=torch.int64) if "label" in blocks.planes else None,
        dropped=dropped,
    )


@kernel("find_triangles", "cuda")
def find_triangles(blocks: VoxelBlocks, edge: Tensor, *, min_weight: int) -> tuple[Tensor, Tensor]:
    """Pack the signs of every block into words, count its triangles, write them, and number the vertices in use."""
    count, device = len(blocks), blocks.device
    launcher = launcher_of(edge)
    rows = blocks.sorted_rows
    signs = torch.empty((count, 2 * _GROUPS), dtype=torch.int32, device=device)
    bound = min(min_weight - 1, MAX_WEIGHT)
    launcher.launch("pc_find_signs", count * VOXELS, rows, count, *planes_of(launcher, blocks), bound, signs)
    vertices = torch.empty((count, 3 * _GROUPS), dtype=torch.int32, device=device)
    first = torch.empty((count, _GROUPS), dtype=torch.int64, device=device)
    launcher.launch("pc_index_vertices", count * _GROUPS, edge, len(edge), count, vertices, first)
    place_of_row = torch.empty_like(rows)
    place_of_row[rows] = torch.arange(count, dtype=torch.int64, device=device)
    cases, corner, axis = marching.tensor_tables(device)
    tables = signs, vertices, first, cases, 3 * corner + axis
    mesh = blocks.sorted_keys, place_of_row, *row_table(launcher, blocks), *tables
    counts = torch.zeros(count + 1, dtype=torch.int64, device=device)
    launcher.launch_blocks("pc_count_triangles", count, *mesh, counts[1:], block=VOXELS)
    starts = counts.cumsum(0)
    triangles = torch.empty((int(starts[-1]), 3), dtype=torch.int64, device=device)
    is_used = torch.zeros(len(edge), dtype=torch.bool, device=device)
    if len(triangles):
        launcher.launch_blocks("pc_write_triangles", count, *mesh, starts, triangles, is_used, block=VOXELS)
    number = is_used.cumsum(0) - 1
    return is_used.nonzero().squeeze(1), number[triangles]
