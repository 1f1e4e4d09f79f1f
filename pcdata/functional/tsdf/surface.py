"""Where the signed distance crosses zero along the edges of the grid: surface points, or the vertices of a mesh."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count
from pcdata.functional.rows import pick_rows
from pcdata.functional.tsdf.blocks import BLOCKS, COLOR_SCALE, TSDF_SCALE, VoxelBlocks
from pcdata.functional.tsdf.grid import EDGE, GRID, VOXELS, VoxelGrid, unpack_keys
from pcdata.functional.tsdf.margins import SIDE, own_places, plane_with_margin, rows_around
from pcdata.threads import at_once

_TOGETHER = 512  # blocks read in one go: 0.7 million voxels with their margins
# Ends of one edge that differ by more lie on two surfaces: the front of one seen past the edge of another. A surface
# seen at 78 degrees changes by one truncation over an edge across it when the truncation is five voxels.
MAX_STEP = TSDF_SCALE
_STRIDE = (1, SIDE, SIDE * SIDE)  # of x, y, z in a flattened margin array


@dataclass(frozen=True, eq=False)
class Crossings:
    """Zero crossings, ordered by edge."""

    edge: Tensor  # (M,) int64: 3 * (512 * place of the block in key order + voxel) + axis; (0,) if not asked for
    points: Tensor  # (M, 3) float32 metres
    normals: Tensor  # (M, 3) float32 unit, out of the surface
    weight: Tensor  # (M,) float32: the stored weight of the end that was seen less
    views: Tensor  # (M,) int64: likewise
    colors: Tensor | None  # (M, 3) float32 in [0, 1]
    labels: Tensor | None  # (M,) int64
    dropped: int  # how many more there are whose ends were seen less than asked for

    def select(self, rows: Tensor) -> Crossings:
        """Keep some rows (K,) int64, without their edges."""
        columns = {name: value for name, value in vars(self).items() if isinstance(value, Tensor) and name != "edge"}
        chosen: dict[str, Any] = {**vars(self), "edge": rows[:0], **pick_rows(columns, rows)}
        return Crossings(**chosen)

    @staticmethod
    def cat(parts: list[Crossings]) -> Crossings:
        """Put parts one after another."""
        joined: dict[str, Any] = {}
        for entry in fields(Crossings):
            column = [getattr(part, entry.name) for part in parts]
            joined[entry.name] = torch.cat(column) if isinstance(column[0], Tensor) else column[0]
        return Crossings(**{**joined, "dropped": sum(part.dropped for part in parts)})


@op(blocks=BLOCKS, grid=GRID, min_weight=checked_count, gradient=False)
def find_crossings(
    blocks: VoxelBlocks, grid: VoxelGrid, *, min_weight: int = 1, edges: bool = False, backend: str = "auto"
) -> Crossings:
    """Find every zero crossing between neighbors along x, y and z that were both seen, with ``min_weight`` at least.

    Point, color and gradient are interpolated linearly between the ends; the label is that of the nearer end, of the
    first at equal distance; the normal is the gradient's direction. An edge whose ends differ by more than a truncation
    belongs to no surface.
    """
    keys = blocks.sorted_keys
    together = at_once(keys.device, _TOGETHER)
    parts = [
        _crossings_of(blocks, keys[start : start + together], start, grid, min_weight, edges)
        for start in range(0, max(len(keys), 1), together)
    ]
    return Crossings.cat(parts)


def _crossings_of(
    blocks: VoxelBlocks, keys: Tensor, first: int, grid: VoxelGrid, min_weight: int, edges: bool
) -> Crossings:
    if len(keys) == 0:
        return _none(blocks)
    rows = rows_around(blocks, keys)
    tsdf = plane_with_margin(blocks, "tsdf", rows).float()
    weight = plane_with_margin(blocks, "weight", rows).float()
    value = torch.where(weight > 0, tsdf, torch.nan)
    own = own_places(tsdf.device)
    here = value[:, own, None]
    there = torch.stack([value[:, own + stride] for stride in _STRIDE], dim=-1)
    crosses = ((here < 0) != (there < 0)) & ((here - there).abs() <= MAX_STEP)  # false with a NaN
    block, voxel, axis = crosses.nonzero(as_tuple=True)
    start = own[voxel]
    end = start + torch.tensor(_STRIDE, dtype=torch.int64, device=tsdf.device)[axis]
    least = torch.minimum(weight[block, start], weight[block, end])
    kept = least >= min_weight
    block, voxel, axis, start, end, least = (column[kept] for column in (block, voxel, axis, start, end, least))
    before, after = value[block, start], value[block, end]
    fraction = before / (before - after)
    offset = torch.stack([voxel % EDGE, voxel // EDGE % EDGE, voxel // EDGE**2], dim=-1)
    place = (unpack_keys(keys)[block] * EDGE + offset).double()
    place[torch.arange(len(axis), dtype=torch.int64, device="cpu"), axis] += fraction.double()
    nearer = torch.where(fraction <= 0.5, start, end)
    return Crossings(
        edge=3 * (VOXELS * (first + block) + voxel) + axis if edges else axis[:0],
        points=(place * grid.voxel_size).float(),
        normals=_unit(_gradient(value, block, start, end, fraction), axis, after - before),
        weight=least,
        views=_least_views(plane_with_margin(blocks, "views", rows), block, start, end)
        if "views" in blocks.planes
        else least.long(),
        colors=_colors(plane_with_margin(blocks, "color", rows), block, start, end, fraction)
        if "color" in blocks.planes
        else None,
        labels=plane_with_margin(blocks, "label", rows)[block, nearer].long() if "label" in blocks.planes else None,
        dropped=len(kept) - len(least),
    )


def _gradient(value: Tensor, block: Tensor, start: Tensor, end: Tensor, fraction: Tensor) -> Tensor:
    """Return (M, 3): the slope per voxel at a crossing, smoothed; 0 along an axis without a seen neighbor.

    The mean rise between the two voxels on one side and the two on the other, over the nine lines along the axis,
    weighted 4, 2, 1 from the middle to the corners: per step the weighted rises of the pairs that were seen whole, by
    their weighted steps. Both ends of the edge count by how near they are. Where no pair was seen whole, it is the
    difference to the one neighbor of the nearer end that was.

    A distance is that of the nearest pixel, so the field has stairs a pixel wide, and the difference of the next two
    voxels alone follows them. Source: the operator of Sobel & Feldman, A 3x3 Isotropic Gradient Operator, 1968, with a
    difference of boxes of two voxels along the axis.
    """
    slopes = []
    for axis in range(3):
        rise, steps = (
            one + (other - one) * fraction
            for one, other in zip(_rise(value, block, start, axis), _rise(value, block, end, axis), strict=True)
        )
        nearer = torch.where(fraction <= 0.5, start, end)
        slopes.append(torch.where(steps > 0, rise / (2 * steps), _one_sided(value, block, nearer, _STRIDE[axis])))
    return torch.stack(slopes, dim=-1)


def _rise(value: Tensor, block: Tensor, place: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Sum up, with their weights, the rises (M,) of the pairs of seen voxels around a place, and their steps (M,).

    A pair lies one or two steps below and above. Whole numbers below 2^24, so sums are exact in any order.
    """
    stride = _STRIDE[axis]
    one, other = (across for a, across in enumerate(_STRIDE) if a != axis)
    rises, steps = torch.zeros_like(value[block, place]), torch.zeros_like(value[block, place])
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            middle = place + (i * one + j * other)
            for step in (1, 2):
                rise = value[block, middle + step * stride] - value[block, middle - step * stride]
                share = float((2 - abs(i)) * (2 - abs(j)))
                seen = ~rise.isnan()
                rises += torch.where(seen, share * rise, 0.0)
                steps += torch.where(seen, share * step, 0.0)
    return rises, steps


def _one_sided(value: Tensor, block: Tensor, place: Tensor, stride: int) -> Tensor:
    here, below, above = value[block, place], value[block, place - stride], value[block, place + stride]
    return torch.where(above.isnan(), here, above) - torch.where(below.isnan(), here, below)


def _unit(gradient: Tensor, axis: Tensor, step: Tensor) -> Tensor:
    """Return unit normals (M, 3); along the edge where the gradient vanishes."""
    length = (
        (gradient[:, 0] * gradient[:, 0] + gradient[:, 1] * gradient[:, 1]) + gradient[:, 2] * gradient[:, 2]
    ).sqrt()
    along = torch.zeros_like(gradient)
    along[torch.arange(len(axis), dtype=torch.int64, device="cpu"), axis] = step.sign()
    return torch.where((length > 0)[:, None], gradient / length[:, None], along)


def _least_views(views: Tensor, block: Tensor, start: Tensor, end: Tensor) -> Tensor:
    return torch.minimum(views[block, start], views[block, end]).long()


def _colors(packed: Tensor, block: Tensor, start: Tensor, end: Tensor, fraction: Tensor) -> Tensor:
    first, second = packed[block, start], packed[block, end]
    channels = []
    for shift in (0, 10, 20):
        a, b = ((first >> shift) & 1023).float(), ((second >> shift) & 1023).float()
        channels.append((a + (b - a) * fraction) * (1 / (255 * COLOR_SCALE)))
    return torch.stack(channels, dim=-1)


def _none(blocks: VoxelBlocks) -> Crossings:
    empty = torch.empty(0, dtype=torch.float32, device=blocks.device)
    return Crossings(
        edge=empty.long(),
        points=empty.reshape(0, 3),
        normals=empty.reshape(0, 3),
        weight=empty,
        views=empty.long(),
        colors=empty.reshape(0, 3) if "color" in blocks.planes else None,
        labels=empty.long() if "label" in blocks.planes else None,
        dropped=0,
    )
