"""How far pcdata's fused surface lies from Open3D's, and for every point that is off, which readings made it so.

Both average signed distances along z at the nearest pixel, so they can only differ in which readings join the average:

* A reading more than a truncation behind a voxel is free space there. Open3D averages it in as a full truncation, in
  the blocks of 16 x 16 x 16 that the view touches; pcdata does so in the blocks of 8 x 8 x 8 that it touches, in voxels
  that were seen before, and with ``carve="never"`` nowhere.
* Open3D opens the blocks along every fourth pixel's ray, pcdata along every pixel's: at rims and on thin things some
  voxels near the surface belong to no block, or to none that this view touches.
* Open3D does not read an image's last column and row: it asks that the coordinate of a pixel's corner, with its
  fraction, be at most the width less one.

``edges_by_cause`` computes both averages anew from the images, in float64, at the two ends of the edges on which
pcdata's points lie, and says in which of these ways the two differ there. The share of ends at which the average so
computed is the one that Open3D stores is returned as well: the causes are as good as that share is high.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from fusion_peer import BLOCK, Open3DGrid, Open3DView
from torch import Tensor

from pcdata.functional.neighbors import knn
from pcdata.functional.tsdf.grid import pack_keys
from pcdata.structures import DepthFrame

_SAMPLES = 20_000
_ALIKE = 1e-3  # truncations


def sampled(points: Tensor) -> Tensor:
    """Every n-th row, about 20 000."""
    return points[:: max(1, len(points) // _SAMPLES)]


def surfaces_apart(ours: Tensor, theirs: Tensor, voxel_size: float) -> dict[str, Any]:
    """The distance from points of one surface to the nearest point of the other, both ways."""
    row: dict[str, Any] = {"points": len(ours), "Open3D points": len(theirs)}
    for name, of, to in (("ours to theirs", ours, theirs), ("theirs to ours", theirs, ours)):
        _, distance = knn(to, queries=sampled(of), k=1)
        row[f"{name}, mm"] = 1000 * float(distance.median())
        row[f"{name}, within half a voxel"] = float((distance < voxel_size / 2).float().mean())
    return row


@dataclass
class Averages:
    """What a voxel holds, computed from the images: (N,) each."""

    near_sum: Tensor  # of readings within the truncation, in truncations
    near: Tensor  # how many those are
    open3d_sum: Tensor  # of those that Open3D averages
    open3d: Tensor
    free: Tensor  # of these, how many are free space
    missed: Tensor  # how many within the truncation Open3D does not read: no block open for the view, or the last pixel


def averages_at(
    voxels: Tensor,  # (N, 3) int64
    frames: Sequence[DepthFrame],
    touched: Sequence[Tensor],  # per frame, the sorted keys of Open3D's blocks
    voxel_size: float,
    truncation: float,
) -> Averages:
    """Average the readings of every frame at some voxels of the whole grid."""
    found = Averages(*(torch.zeros(len(voxels), dtype=torch.float64) for _ in range(6)))
    blocks = pack_keys(torch.div(voxels, BLOCK, rounding_mode="floor"))
    places = voxels.double() * voxel_size
    for frame, keys in zip(frames, touched, strict=True):
        assert frame.world_from_camera is not None
        pose = torch.linalg.inv(frame.world_from_camera[0])
        x, y, z = (places @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
        k, depth = frame.camera.intrinsics[0], frame.depth[0]
        height, width = depth.shape
        right, down = x / z * k[0, 0] + k[0, 2] + 0.5, y / z * k[1, 1] + k[1, 2] + 0.5
        u, v = right.floor().long(), down.floor().long()
        inside = (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        reading = depth[v.clamp(0, height - 1), u.clamp(0, width - 1)].double()
        distance = (reading - z) / truncation
        read = inside & (reading > 0)
        near = read & (distance.abs() <= 1)
        is_open = keys[torch.searchsorted(keys, blocks).clamp(max=len(keys) - 1)] == blocks
        is_open &= (right <= width - 1) & (down <= height - 1)
        joins = read & (distance >= -1) & is_open
        found.near_sum += torch.where(near, distance, 0)
        found.near += near
        found.open3d_sum += torch.where(joins, distance.clamp(max=1), 0)
        found.open3d += joins
        found.free += joins & (distance > 1)
        found.missed += near & ~is_open
    return found


def touched_keys(grid: Open3DGrid, views: Sequence[Open3DView]) -> list[Tensor]:
    """The blocks that Open3D opens for every view, as sorted keys."""
    found = [torch.from_numpy(grid.touched(view).numpy()).long() for view in views]
    return [pack_keys(blocks).sort().values for blocks in found]


def edge_ends(points: Tensor, voxel_size: float) -> tuple[Tensor, Tensor]:
    """The two voxels (N, 3) int64 between which surface points lie: their places are whole on all axes but one."""
    place = points.double() / voxel_size
    axis = (place - place.round()).abs().argmax(dim=1, keepdim=True)
    first = place.round().scatter(1, axis, place.gather(1, axis).floor()).long()
    return first, first.scatter_add(1, axis, torch.ones_like(axis))


def edges_by_cause(
    points: Tensor,  # of pcdata's surface without carving
    theirs: Tensor,  # Open3D's
    grid: Open3DGrid,
    frames: Sequence[DepthFrame],
    views: Sequence[Open3DView],
) -> dict[str, Any]:
    """Divide pcdata's points by what Open3D averaged at the ends of their edges; distances to its nearest point."""
    size = grid.voxel_size
    points = sampled(points)
    _, distance = knn(theirs, queries=points, k=1)
    touched = touched_keys(grid, views)
    free, missed, alike = (torch.zeros(len(points), dtype=torch.bool) for _ in range(3))
    alike |= True
    stored = []
    for voxels in edge_ends(points, size):
        found = averages_at(voxels, frames, touched, size, grid.multiple * size)
        tsdf, weight = grid.voxels(voxels)
        alike &= (weight == found.open3d) & ((tsdf * weight - found.open3d_sum).abs() <= _ALIKE * weight)
        free |= found.free > 0
        missed |= found.missed > 0
        stored.append(torch.where(weight > 0, tsdf, torch.nan))
    crosses = stored[0] * stored[1] < 0
    row: dict[str, Any] = {"predicted": float(alike.float().mean())}
    for name, some in (("free", free), ("missed", missed & ~free), ("same", ~missed & ~free)):
        row[f"{name}, share"] = float(some.float().mean())
        row[f"{name}, Open3D crosses"] = float(crosses[some].float().mean())
        row[f"{name}, mm"] = 1000 * float(distance[some].median())
    return row
