"""Clouds that still lie on depth images: windows of pixels are searched, and a tree that takes no sort for the rest.

As ``core/pc/gpu/organized.hpp`` and ``windows.hpp`` have it; nothing here waits for the device.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from pcdata.functional.image_grid import ImageGrid
from pcdata.kernels.cuda.launching import Launcher
from pcdata.kernels.cuda.trees import BoxTree, boxes_over

_MOST_PIXELS = 4  # per point: windows of an image with fewer points in it are mostly searched in vain
_NONE = 0x7F800000  # infinity, as an ordered number
_WARP, _BLOCK, _TILE = 32, 32, 32  # threads; pixels along a side of a block of tiles; pixels of a tile


class Organized(NamedTuple):
    """Points at the pixels of their images."""

    points: Tensor  # (N, 3)
    ptr: Tensor  # (B+1,)
    image: tuple[Any, ...]  # as kernels take it
    windows: tuple[Any, ...]  # as kernels take them, the image first
    rest: Tensor  # (N,) int64: rows without a proof, after a search of windows
    num_rest: Tensor  # (1,) int32


def organized(launcher: Launcher, points: Tensor, ptr: Tensor, grid: ImageGrid | None) -> Organized | None:
    """Lay points at their pixels, and measure what proves a window; None where that is not worth it."""
    rows, clouds = len(points), len(ptr) - 1
    if grid is None or rows == 0 or clouds * grid.size[0] * grid.size[1] > _MOST_PIXELS * rows:
        return None
    device, (height, width) = points.device, grid.size
    pixels, pixel = height * width, grid.pixel_index.contiguous()
    placed = torch.full((clouds * pixels, 4), -1, dtype=torch.int32, device=device).view(torch.float32)
    launcher.launch("pc_lay_points", rows, points, ptr, clouds, rows, pixel, pixels, placed)
    motion = grid.camera_from_points
    image = placed, clouds, height, width, None if motion is None else motion.double().contiguous()
    slopes = torch.full((clouds, 2 * (width + height)), _NONE, dtype=torch.int32, device=device)
    zeros = torch.zeros(clouds + 1, dtype=torch.int32, device=device)
    unfit, num_rest = zeros[:-1], zeros[-1:]
    strips = clouds * -(-width // _WARP) * -(-height // _WARP)
    launcher.launch("pc_measure_slopes", _WARP * strips, *image, slopes, unfit)
    sides = torch.empty((clouds, 2 * (width + height), 2), dtype=torch.float32, device=device)
    launcher.launch_blocks("pc_bound_sides", clouds, height, width, slopes, sides, block=4 * _WARP)
    rest = torch.empty(rows, dtype=torch.int64, device=device)
    windows = *image, points, sides, unfit, ptr, pixel, rows, rest, num_rest
    return Organized(points, ptr, image, windows, rest, num_rest)


def tile_tree(launcher: Launcher, cloud: Organized) -> BoxTree:
    """Put boxes over points in tiles of pixels, in the order of the tiles; queries are the rest."""
    placed_image, clouds, height, width, _ = cloud.image
    tiles = clouds * -(-width // _BLOCK) * -(-height // _BLOCK) * (_BLOCK * _BLOCK // _TILE)
    device = cloud.points.device
    counts = torch.empty(tiles, dtype=torch.int32, device=device)
    launcher.launch("pc_count_tiles", _WARP * tiles, *cloud.image, counts)
    ends = counts.cumsum(0, dtype=torch.int32)
    placed = torch.zeros((len(cloud.points), 4), dtype=torch.float32, device=device)  # so is what no cloud fills
    launcher.launch("pc_place_tiles", _WARP * tiles, *cloud.image, ends, placed)
    box = placed_image[:0]  # nothing was sorted by it
    return BoxTree(cloud.points, cloud.ptr, box, cloud.rest, placed, *boxes_over(launcher, placed))
