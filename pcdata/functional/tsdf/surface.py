"""Where the signed distance crosses zero along the edges of the grid: surface points, or the vertices of a mesh."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from pcdata.functional.tsdf.apron import SIDE, Neighbourhood
from pcdata.functional.tsdf.blocks import COLOR_SCALE, TSDF_SCALE, VoxelBlocks
from pcdata.functional.tsdf.grid import EDGE, VOXELS, VoxelGrid

_TOGETHER = 512  # blocks read in one go: 0.7 million voxels with their margins
# Ends of one edge that differ by more lie on two surfaces: the front of one seen past the edge of another. A surface
# seen at 78 degrees changes by one truncation over an edge across it when the truncation is five voxels.
MAX_STEP = TSDF_SCALE
_STRIDE = (1, SIDE, SIDE * SIDE)  # of x, y, z in a flattened margin array


@dataclass(frozen=True, eq=False)
class Crossings:
    """Zero crossings, ordered by edge."""

    edge: Tensor  # (M,) int64: 3 * (512 * place of the block in key order + voxel) + axis
    points: Tensor  # (M, 3) float32 metres
    normals: Tensor  # (M, 3) float32 unit, out of the surface
    weight: Tensor  # (M,) int32: of the end that was seen less
    views: Tensor  # (M,) int32: likewise
    colors: Tensor | None  # (M, 3) float32 in [0, 1]
    labels: Tensor | None  # (M,) int64

    def select(self, keep: Tensor) -> Crossings:
        """Keep some rows."""
        rows: dict[str, Any] = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        chosen: dict[str, Any] = {name: None if value is None else value[keep] for name, value in rows.items()}
        return Crossings(**chosen)

    @staticmethod
    def cat(parts: list[Crossings]) -> Crossings:
        """Put parts one after another."""
        columns = {entry.name: [getattr(part, entry.name) for part in parts] for entry in fields(Crossings)}
        joined: dict[str, Any] = {name: None if v[0] is None else torch.cat(v) for name, v in columns.items()}
        return Crossings(**joined)


def find_crossings(blocks: VoxelBlocks, grid: VoxelGrid) -> Crossings:
    """Find every zero crossing between two seen neighbours along x, y and z.

    The point is interpolated linearly, as is the colour; normal and label are those of the nearer end, of the first at
    equal distance; the normal is the gradient's direction there. An edge whose ends differ by more than a truncation
    belongs to no surface.
    """
    keys = blocks.sorted_keys
    parts = [
        _crossings_of(Neighbourhood.of(blocks, keys[start : start + _TOGETHER]), start, grid)
        for start in range(0, max(len(keys), 1), _TOGETHER)
    ]
    return Crossings.cat(parts)


def _crossings_of(some: Neighbourhood, first: int, grid: VoxelGrid) -> Crossings:
    if len(some.corner) == 0:
        return _none(some.blocks)
    count = len(some.corner)
    tsdf = some.plane("tsdf").reshape(count, -1).float()
    weight = some.plane("weight").reshape(count, -1).int()
    value = torch.where(weight > 0, tsdf, torch.nan)
    z, y, x = torch.meshgrid(*[torch.arange(EDGE, device=tsdf.device)] * 3, indexing="ij")
    own = (((z + 1) * SIDE + (y + 1)) * SIDE + (x + 1)).flatten()  # places of the block's own voxels
    here = value[:, own, None]
    there = torch.stack([value[:, own + stride] for stride in _STRIDE], dim=-1)
    crosses = ((here < 0) != (there < 0)) & ((here - there).abs() <= MAX_STEP)  # false with a NaN
    block, voxel, axis = crosses.nonzero(as_tuple=True)
    start = own[voxel]
    end = start + torch.tensor(_STRIDE, device=tsdf.device)[axis]
    before, after = value[block, start], value[block, end]
    fraction = before / (before - after)
    offset = torch.stack([voxel % EDGE, voxel // EDGE % EDGE, voxel // EDGE**2], dim=-1)
    place = (some.corner[block] + offset).double()
    place[torch.arange(len(axis)), axis] += fraction.double()
    views = weight if some.blocks.planes.views is False else some.plane("views").reshape(count, -1).int()
    nearer = torch.where(fraction <= 0.5, start, end)
    gradient = _gradient(value, block, nearer)
    return Crossings(
        edge=3 * (VOXELS * (first + block) + voxel) + axis,
        points=(place * grid.voxel_size).float(),
        normals=_unit(gradient, axis, after - before),
        weight=torch.minimum(weight[block, start], weight[block, end]),
        views=torch.minimum(views[block, start], views[block, end]),
        colors=_colors(some, block, start, end, fraction) if some.blocks.planes.colors else None,
        labels=some.plane("label").reshape(count, -1)[block, nearer].long() if some.blocks.planes.labels else None,
    )


def _gradient(value: Tensor, block: Tensor, place: Tensor) -> Tensor:
    """Return (M, 3): the slope per voxel at a seen voxel, smoothed across; 0 along an axis without a seen neighbour.

    Central differences of the nine pairs of neighbours along each axis, weighted 4, 2, 1 from the middle to the
    corners (Sobel's); where no pair was seen whole, the difference to the one neighbour that was.
    """
    slopes = []
    for axis, stride in enumerate(_STRIDE):
        one, other = (across for b, across in enumerate(_STRIDE) if b != axis)
        total, weight = torch.zeros_like(value[block, place]), torch.zeros_like(value[block, place])
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                middle = place + (i * one + j * other)
                rise = value[block, middle + stride] - value[block, middle - stride]
                share = float((2 - abs(i)) * (2 - abs(j)))
                seen = ~rise.isnan()
                total += torch.where(seen, share * rise, 0.0)
                weight += torch.where(seen, share, 0.0)
        slopes.append(torch.where(weight > 0, total / (2 * weight), _one_sided(value, block, place, stride)))
    return torch.stack(slopes, dim=-1)


def _one_sided(value: Tensor, block: Tensor, place: Tensor, stride: int) -> Tensor:
    here, below, above = value[block, place], value[block, place - stride], value[block, place + stride]
    return torch.where(above.isnan(), here, above) - torch.where(below.isnan(), here, below)


def _unit(gradient: Tensor, axis: Tensor, step: Tensor) -> Tensor:
    """Return unit normals (M, 3); along the edge where the gradient vanishes."""
    length = (
        (gradient[:, 0] * gradient[:, 0] + gradient[:, 1] * gradient[:, 1]) + gradient[:, 2] * gradient[:, 2]
    ).sqrt()
    along = torch.zeros_like(gradient)
    along[torch.arange(len(axis)), axis] = step.sign()
    return torch.where((length > 0)[:, None], gradient / length[:, None], along)


def _colors(some: Neighbourhood, block: Tensor, start: Tensor, end: Tensor, fraction: Tensor) -> Tensor:
    packed = some.plane("color").reshape(len(some.corner), -1)
    first, second = packed[block, start], packed[block, end]
    channels = []
    for shift in (0, 10, 20):
        a, b = ((first >> shift) & 1023).float(), ((second >> shift) & 1023).float()
        channels.append((a + (b - a) * fraction) * (1 / (255 * COLOR_SCALE)))
    return torch.stack(channels, dim=-1)


def _none(blocks: VoxelBlocks) -> Crossings:
    empty = torch.empty(0, device=blocks.device)
    return Crossings(
        edge=empty.long(),
        points=empty.reshape(0, 3),
        normals=empty.reshape(0, 3),
        weight=empty.int(),
        views=empty.int(),
        colors=empty.reshape(0, 3) if blocks.planes.colors else None,
        labels=empty.long() if blocks.planes.labels else None,
    )
