"""Triangles between zero crossings: marching cubes with tables made from the faces of the cube.

Source: Lorensen & Cline, Marching Cubes, 1987. On a face with two opposite corners inside, those two are kept apart in
every cube, so that neighboring cubes agree and the surface has no cracks.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count
from pcdata.contracts.on_host import uploaded
from pcdata.functional.tsdf.blocks import BLOCKS, VoxelBlocks
from pcdata.functional.tsdf.grid import EDGE, VOXELS
from pcdata.functional.tsdf.margins import SIDE, own_places, plane_with_margin, rows_around
from pcdata.threads import at_once

_TOGETHER = 512  # blocks
Edge = tuple[int, int]  # the corners it joins; corner c lies at (c & 1, c >> 1 & 1, c >> 2)

# The corners of every face, going round so that the face is on the left of one who walks outside the cube.
_FACES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


@cache
def triangle_table() -> list[list[tuple[Edge, Edge, Edge]]]:
    """Return, for each of the 256 sets of inside corners (bit c: corner c), the triangles as cut edges of the cube.

    Seen from outside the body, corners run counter-clockwise.
    """
    return [[triangle for loop in _loops(inside) for triangle in _fan(loop)] for inside in range(256)]


def _loops(inside: int) -> list[list[Edge]]:
    """Trace the closed lines in which the surface cuts the faces of the cube."""
    follows: dict[Edge, Edge] = {}
    for face in _FACES:
        is_in = [bool(inside >> corner & 1) for corner in face]
        sides = [_edge(face[i], face[(i + 1) % 4]) for i in range(4)]
        leaves = [i for i in range(4) if is_in[i] and not is_in[(i + 1) % 4]]
        for i in leaves:
            # Back to where this run of inside corners began: runs on one face stay apart.
            begin = i
            while is_in[(begin - 1) % 4]:
                begin -= 1
            follows[sides[i]] = sides[(begin - 1) % 4]
    loops = []
    while follows:
        start, at = next(iter(follows.items()))
        loop = [start]
        del follows[start]
        while at != start:
            loop.append(at)
            at = follows.pop(at)
        loops.append(loop)
    return loops


def _fan(loop: list[Edge]) -> list[tuple[Edge, Edge, Edge]]:
    return [(loop[0], loop[i + 1], loop[i]) for i in range(1, len(loop) - 1)]


def _edge(a: int, b: int) -> Edge:
    return min(a, b), max(a, b)


@op(blocks=BLOCKS, edge="M : int64", min_weight=checked_count, gradient=False)
def find_triangles(
    blocks: VoxelBlocks,
    edge: Tensor,  # (M,) int64, rising: the edges with a vertex, numbered as in Crossings
    *,
    min_weight: int = 1,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # used (K,) int64 rows of the vertices, rising; triangles (T, 3) int64 rows of used
    """Find the surface within the cubes whose eight corners were seen, with ``min_weight`` at least.

    Triangles are ordered by cube. One with a corner that has no vertex is left out.
    """
    keys = blocks.sorted_keys
    tables = tensor_tables(blocks.device)
    parts = [
        _triangles_of(blocks, rows_around(blocks, some), min_weight, tables)
        for some in keys.split(at_once(keys.device, _TOGETHER))
        if len(some)
    ]
    edges = torch.cat(parts) if parts else torch.empty((0, 3), dtype=torch.int64, device=blocks.device)
    if len(edge) == 0:
        return edge, edges[:0]
    place = torch.searchsorted(edge, edges).clamp_(max=len(edge) - 1)
    complete = place[(edge[place] == edges).all(1)]
    used, triangles = complete.unique(return_inverse=True)
    return used, triangles.reshape(-1, 3)


def tensor_tables(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return first triangle of each case (257,), and per corner of a triangle (K, 3) its edge's start and axis."""
    table = triangle_table()
    counts = torch.tensor([0, *(len(triangles) for triangles in table)], dtype=torch.int64, device="cpu").cumsum(0)
    flat = [triangle for triangles in table for triangle in triangles]
    start = torch.tensor([[a for a, _ in triangle] for triangle in flat], dtype=torch.int64, device="cpu")
    axis = torch.tensor(
        [[(b - a).bit_length() - 1 for a, b in triangle] for triangle in flat], dtype=torch.int64, device="cpu"
    )
    return uploaded(counts, device), uploaded(start, device), uploaded(axis, device)


def _triangles_of(
    blocks: VoxelBlocks, rows: Tensor, min_weight: int, tables: tuple[Tensor, Tensor, Tensor]
) -> Tensor:  # (T, 3) int64 edges, numbered as in Crossings
    counts, starts, axes = tables
    seen = plane_with_margin(blocks, "weight", rows) >= min_weight
    inside = plane_with_margin(blocks, "tsdf", rows) < 0
    own = own_places(seen.device)
    case = torch.zeros((len(rows), VOXELS), dtype=torch.int64, device=seen.device)
    complete = torch.ones_like(case, dtype=torch.bool)
    for corner in range(8):
        at = own + (corner & 1) + SIDE * (corner >> 1 & 1) + SIDE * SIDE * (corner >> 2)
        case |= inside[:, at].long() << corner
        complete &= seen[:, at]
    per_cube = torch.where(complete, (counts[1:] - counts[:-1])[case], 0)
    block, voxel = per_cube.nonzero(as_tuple=True)
    repeat = per_cube[block, voxel]
    first = torch.repeat_interleave(counts[case[block, voxel]] - (repeat.cumsum(0) - repeat), repeat)
    row = first + torch.arange(len(first), dtype=torch.int64, device=first.device)
    block, voxel = torch.repeat_interleave(block, repeat), torch.repeat_interleave(voxel, repeat)
    return _edge_numbers(blocks, rows, block, voxel, starts[row], axes[row])


def _edge_numbers(
    blocks: VoxelBlocks, rows: Tensor, block: Tensor, voxel: Tensor, corner: Tensor, axis: Tensor
) -> Tensor:
    """Number the edges that start at a corner (T, 3) of the cubes at these voxels (T,) and run along an axis (T, 3)."""
    at = [((voxel // size % EDGE)[:, None] + (corner >> bit & 1)) for bit, size in enumerate((1, EDGE, EDGE * EDGE))]
    step = [(place == EDGE).long() for place in at]
    around = 13 + step[0] + 3 * step[1] + 9 * step[2]
    row = rows[block[:, None], around]
    place_of_row = torch.empty_like(blocks.sorted_rows)
    place_of_row[blocks.sorted_rows] = torch.arange(len(blocks), dtype=torch.int64, device=rows.device)
    inner = (at[0] % EDGE) + EDGE * (at[1] % EDGE) + EDGE * EDGE * (at[2] % EDGE)
    return 3 * (VOXELS * place_of_row[row] + inner) + axis
