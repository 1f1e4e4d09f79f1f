"""Finding the blocks that a view touches, and averaging its signed distances into them.

Source: Curless & Levoy, A Volumetric Method for Building Complex Models from Range Images, 1996; blocks as in Niessner
et al., Real-time 3D Reconstruction at Scale using Voxel Hashing, 2013; the vote of labels is that of Boyer & Moore,
MJRTY, 1991.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.on_host import on_host, uploaded
from pcdata.functional.tsdf.blocks import BLOCKS, MAX_WEIGHT, TSDF_SCALE, Chunk, VoxelBlocks
from pcdata.functional.tsdf.grid import GRID, VoxelGrid, pack_keys, unpack_keys, voxel_offsets
from pcdata.functional.tsdf.views import VIEW, VIEWS, FusionView, refuse_labels
from pcdata.geometry.lens import distort_normalized
from pcdata.geometry.lens_models import is_plain
from pcdata.threads import at_once

_TOGETHER = 2048  # blocks updated in one go: a million voxels
_FURTHEST = 2.0**40  # blocks; beyond what keys reach
_SHARE_STEPS = 1 << 15  # of a pixel's share in a color, which is mixed in integers


@op(view=VIEW, grid=GRID, gradient=False)
def touched_blocks(view: FusionView, grid: VoxelGrid, *, backend: str = "auto") -> Tensor:
    """Return the sorted keys (N,) of the blocks within the truncation band of a view's readings.

    Along the ray of every reading, blocks are looked up half a block apart, from one truncation in front to one behind.
    """
    turn, fraction, camera = camera_in_blocks(view, grid)
    camera = uploaded(camera, view.depth.device)
    read = view.depth > 0
    depth, (x, y) = view.depth[read], view.rays[:, read]
    along = [(t[0] * x + t[1] * y) + t[2] for t in turn]
    found = []
    for offset in band(grid):
        z = depth + offset
        place = torch.stack([(a * z + start).floor() for a, start in zip(along, fraction, strict=True)], dim=-1)
        place = place[z > 0].nan_to_num(nan=_FURTHEST).clamp(-_FURTHEST, _FURTHEST)  # as whole numbers they would wrap
        found.append(pack_keys(place.long() + camera).unique())
    return torch.cat(found).unique()


@op(blocks=BLOCKS, keys="N : int64", gradient=False)
def find_blocks(blocks: VoxelBlocks, keys: Tensor, *, backend: str = "auto") -> tuple[Tensor, Tensor]:
    """Return the row (N,) of every key, -1 where there is no block, and the keys (M,) of which this is true."""
    rows = blocks.find(keys)
    return rows, keys[rows < 0]


@op(blocks=BLOCKS, views=VIEWS, grid=GRID, gradient=False)
def locate_views(
    blocks: VoxelBlocks, views: Sequence[FusionView], grid: VoxelGrid, *, backend: str = "auto"
) -> tuple[list[Tensor], Tensor]:
    """Return the rows (N,) of the blocks that each view touches, in key order, and the sorted keys (M,) of new ones.

    A missing block has the row that it gets when these keys are added next.

    Raises:
        CaptureError: a label did not fit the 32 bits of a voxel.
        UnitError: a block lies more than 2^20 blocks from the origin.
    """
    refuse_labels(any(view.unfit is not None and bool(view.unfit) for view in views))
    touched = [touched_blocks(view, grid, backend="torch") for view in views]
    found = [find_blocks(blocks, keys, backend="torch") for keys in touched]
    return located(blocks, touched, found)


def located(
    blocks: VoxelBlocks, touched: Sequence[Tensor], found: Sequence[tuple[Tensor, Tensor]]
) -> tuple[list[Tensor], Tensor]:
    """Put together what was found of the keys that each view touches."""
    missing = found[0][1] if len(found) == 1 else torch.cat([keys for _, keys in found]).unique()
    return [with_new_rows(blocks, rows, keys, missing) for (rows, _), keys in zip(found, touched)], missing


def with_new_rows(blocks: VoxelBlocks, rows: Tensor, keys: Tensor, missing: Tensor) -> Tensor:
    """Give missing blocks, row -1, the rows that they will have."""
    if len(missing) == 0:
        return rows
    return torch.where(rows < 0, torch.searchsorted(missing, keys) + len(blocks), rows)


def camera_in_blocks(view: FusionView, grid: VoxelGrid) -> tuple[Tensor, Tensor, Tensor]:
    """Return how to count blocks from the camera's own, in float32 without losing any, however far the origin is.

    The rotation in blocks per metre (3, 3) float32, the camera's place within its block (3,) float32, and that block
    (3,) int64; all on the host.
    """
    pose = on_host(view.world_from_camera)
    place = pose[:3, 3] / grid.block_size
    block = place.floor()
    return (
        (pose[:3, :3] / grid.block_size).float(),
        (place - block).float(),
        block.clamp(-_FURTHEST, _FURTHEST).long(),
    )


def band(grid: VoxelGrid) -> Tensor:
    """Return the offsets along z at which blocks are looked up, float32 metres."""
    return torch.tensor(grid.band, dtype=torch.float32, device="cpu")


@op(blocks=BLOCKS, rows="R : int64", view=VIEW, grid=GRID, mutates=("blocks",), gradient=False)
def integrate_view(
    blocks: VoxelBlocks, rows: Tensor, view: FusionView, grid: VoxelGrid, *, carve: bool, backend: str = "auto"
) -> None:
    """Average a view into the given rows of the blocks, in place.

    The signed distance of a voxel is the reading at its nearest pixel less its own depth, along z. Within the
    truncation it joins the running average; beyond, behind the surface, the view says nothing; in front of it,
    ``carve`` averages a full truncation into voxels that were seen before.
    """
    for chunk, inside, where in blocks.in_chunks(rows):
        together = at_once(inside.device, _TOGETHER)
        for start in range(0, len(inside), together):
            some = slice(start, start + together)
            _update(chunk, inside[some], blocks.keys[rows[where[some]]], view, grid, carve)


def _update(chunk: Chunk, rows: Tensor, keys: Tensor, view: FusionView, grid: VoxelGrid, carve: bool) -> None:
    pixel, distance = _distances(block_corners(keys, view, grid), view, grid)
    scaled = distance * torch.tensor(TSDF_SCALE / grid.truncation, dtype=torch.float32, device="cpu")
    near = scaled.abs() <= TSDF_SCALE
    weight = chunk["weight"][rows]
    seen = near | ((scaled > TSDF_SCALE) & (weight > 0)) if carve else near
    old = weight.float()
    more = torch.ones_like(old) if view.weight is None else view.weight.flatten()[pixel].float()
    share = more / (old + more)
    tsdf = chunk["tsdf"][rows].float()
    average = (tsdf + (scaled.clamp(max=TSDF_SCALE) - tsdf) * share).round()
    chunk["tsdf"][rows] = torch.where(seen, average, tsdf).short()
    chunk["weight"][rows] = torch.where(seen, (old + more).clamp(max=MAX_WEIGHT), old).short()
    count = chunk["views"][rows] if "views" in chunk else weight
    if "color" in chunk and view.color is not None:
        color = chunk["color"][rows]
        mixed = _mixed_color(color, view.color.flatten()[pixel], share, count)
        chunk["color"][rows] = torch.where(near, mixed, color)
    if "label" in chunk and view.label is not None:
        _vote(chunk["label"], chunk["votes"], rows, view.label.flatten()[pixel], near)
    if "views" in chunk:
        chunk["views"][rows] = torch.where(seen, (count.int() + 1).clamp(max=MAX_WEIGHT), count.int()).short()


def image_from_world(view: FusionView) -> Tensor:
    """Return (3, 4) float64: the place of a point in the image, times its depth, and the depth.

    Pixel (u, v) is where the place is in [u, u + 1) x [v, v + 1). With a lens, which is not linear: the point in the
    camera's frame. It is on the host.
    """
    if view.distortion is not None:
        return view.camera_from_world[:3]
    fx, skew, cx, fy, cy = view.pinhole
    image = [[fx, skew, cx + 0.5], [0.0, fy, cy + 0.5], [0.0, 0.0, 1.0]]
    return torch.tensor(image, dtype=torch.float64, device="cpu") @ view.camera_from_world[:3]


def block_corners(keys: Tensor, view: FusionView, grid: VoxelGrid) -> Tensor:
    """Return the first voxel of every block, as the view maps it, (N, 3) float32, rounded once from float64."""
    pose = image_from_world(view).tolist()
    x, y, z = (unpack_keys(keys).double() * grid.block_size).unbind(-1)
    return torch.stack([((r[0] * x + r[1] * y) + r[2] * z) + r[3] for r in pose], dim=-1).float()


def voxel_steps(view: FusionView, grid: VoxelGrid) -> Tensor:
    """Return (3, 512) float32: where a block's voxels lie from its first one, as the view maps them."""
    steps = (image_from_world(view)[:, :3] * grid.voxel_size).float()
    x, y, z = voxel_offsets(view.depth.device).float().unbind(-1)
    return torch.stack([(x * s[0] + y * s[1]) + z * s[2] for s in steps])


def _distances(corners: Tensor, view: FusionView, grid: VoxelGrid) -> tuple[Tensor, Tensor]:
    """Return the nearest pixel (N, 512) int64 of every voxel and its signed distance in metres; NaN where unseen."""
    height, width = view.depth.shape
    x, y, z = (corner[:, None] + step for corner, step in zip(corners.unbind(-1), voxel_steps(view, grid), strict=True))
    inverse = 1.0 / z
    u, v = x * inverse, y * inverse
    ahead = z > 0
    if view.distortion is not None:
        radius = u * u + v * v
        ahead &= radius < torch.tensor(view.fold, dtype=torch.float32, device="cpu")
        if is_plain(view.distortion):
            x, y = bend(u, v, radius, on_host(view.distortion).float())
        else:
            seen = torch.stack([torch.where(ahead, one, 0.0) for one in (u, v)], dim=-1)
            lens = uploaded(on_host(view.distortion), seen.device)
            x, y = distort_normalized(seen[None], lens[None])[0].float().unbind(-1)
        fx, skew, cx, fy, cy = torch.tensor(view.pinhole, dtype=torch.float32, device="cpu").unbind()
        u, v = ((x * fx + y * skew) + cx) + 0.5, (y * fy + cy) + 0.5
    inside = ahead & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    pixel = torch.where(inside, v, 0.0).long() * width + torch.where(inside, u, 0.0).long()
    reading = view.depth.flatten()[pixel]
    return pixel, torch.where(inside & (reading > 0), reading - z, torch.nan)


def bend(x: Tensor, y: Tensor, r2: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Bend normalized coordinates as the lens does, in float32 and in the order of operations that kernels repeat."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = c.unbind()
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xy = (2 * x) * y
    bent_x = ((x * radial + p1 * xy) + p2 * (r2 + (2 * x) * x)) + (s1 + s2 * r2) * r2
    bent_y = ((y * radial + p1 * (r2 + (2 * y) * y)) + p2 * xy) + (s3 + s4 * r2) * r2
    return bent_x, bent_y


def _mixed_color(old: Tensor, pixel: Tensor, share: Tensor, count: Tensor) -> Tensor:
    """Average a pixel's color into the stored one.

    Rounded up or down in turn, by the multiples of the golden ratio: rounding to nearest would ignore small
    differences for good once the weights are large.
    """
    voxel = torch.arange(old.shape[1], dtype=torch.int32, device=old.device)
    turn = ((count.int() * 159 + voxel * 83) & 255) * (_SHARE_STEPS // 256)
    steps = (share * _SHARE_STEPS).round().int()
    mixed = old.clone()
    for shift in (0, 10, 20):
        apart = ((pixel >> shift) & 1023) - ((old >> shift) & 1023)
        mixed += ((apart * steps + turn) >> 15) << shift
    return mixed


def _vote(label: Tensor, votes: Tensor, rows: Tensor, seen: Tensor, near: Tensor) -> None:
    """Count one vote per view: a label that more than half of the views gave is the candidate in the end."""
    candidate, lead = label[rows], votes[rows].int()
    agrees, is_open = seen == candidate, lead == 0
    after = torch.where(agrees | is_open, (lead + 1).clamp(max=MAX_WEIGHT), lead - 1)
    label[rows] = torch.where(near & is_open, seen, candidate)
    votes[rows] = torch.where(near, after, lead).short()
