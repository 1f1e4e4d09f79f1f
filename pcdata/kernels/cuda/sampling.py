"""Farthest points: a block for each of many clouds, all blocks for a large one, several picks between two meetings."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

import pcdata.functional.sampling  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.asked_later import constant
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.functional.rows import ptr_from_counts
from pcdata.kernels.cuda.launching import Launcher, launcher_of
from pcdata.kernels.cuda.trees import in_order

_MOST_ROWS = 2**32 - 2  # a key counts them down in 32 bits
_LARGE = 1 << 15  # points a cloud, from which all blocks sample one together: meeting costs more than within a block
_WARP, _MOST_THREADS = 32, 1024
_BLOCK, _TILE, _MOST_TILES = 256, 1024, 1024  # threads and points of a tile; tiles, kMostTiles of the kernel


@kernel("farthest_rows", "cuda", roomy=True)
def farthest_rows(points: Tensor, ptr: Tensor, counts: list[int]) -> Tensor:
    """Pick in one kernel, or in one for each cloud where these are large; no pick waits for the host."""
    clouds, (rows, width), device = len(counts), points.shape, points.device
    if not width or rows > _MOST_ROWS:
        fallen: Tensor = INNER["farthest_rows"].reference(points, ptr, counts)
        return fallen
    launcher = launcher_of(points)
    points, ptr = points.detach().contiguous(), ptr.contiguous()
    picks = torch.empty(sum(counts), dtype=torch.int64, device=device)
    nearest = torch.empty(rows, dtype=torch.float32, device=device)
    each = rows // max(1, clouds)
    if each < _LARGE:
        picks_ptr = constant(_begins(tuple(counts), device))
        block = min(_MOST_THREADS, _WARP << max(0, (each - 1) // _WARP).bit_length())
        launcher.launch_blocks("pc_sample_clouds", clouds, points, ptr, width, picks_ptr, nearest, picks, block=block)
        return picks
    if width == 3:
        _sample_in_passes(launcher, points, ptr, counts, nearest, picks)
        return picks
    best = torch.zeros(sum(counts), dtype=torch.int64, device=device)
    arrivals = torch.zeros(clouds, dtype=torch.int32, device=device)
    blocks, begin = launcher.resident_blocks("pc_sample_cloud", _MOST_THREADS), 0
    for cloud, count in enumerate(counts):
        launcher.launch_blocks(
            "pc_sample_cloud",
            *(blocks, points, width, begin, ptr, cloud, count, nearest),
            *(best[begin:], arrivals[cloud:], picks),
            block=_MOST_THREADS,
        )
        begin += count
    return picks


def _sample_in_passes(
    launcher: Launcher, points: Tensor, ptr: Tensor, counts: list[int], nearest: Tensor, picks: Tensor
) -> None:
    """Sample each cloud by all blocks, a tile of neighboring points for each."""
    rows, device = len(points), points.device
    order = in_order(launcher, points, ptr, torch.stack(points.aminmax(dim=0)))
    placed = torch.empty((rows, 4), dtype=torch.float32, device=device)
    launcher.launch("pc_place_in_order", rows, points, order, rows, placed)
    blocks = min(launcher.resident_blocks("pc_sample_in_passes", _BLOCK), _MOST_TILES, max(1, rows // _TILE))
    arrivals = torch.zeros(len(counts), dtype=torch.int32, device=device)
    keys, rests = torch.empty((2, 2 * blocks), dtype=torch.int64, device=device).unbind()
    spots = torch.empty((2 * blocks, 3), dtype=torch.float32, device=device)
    begin = 0
    for cloud, count in enumerate(counts):
        if count:
            launcher.launch_blocks(
                "pc_sample_in_passes",
                *(blocks, points, placed, ptr, cloud, begin, count, nearest),
                *(keys, rests, spots, arrivals[cloud:], picks),
                block=_BLOCK,
            )
        begin += count


@functools.lru_cache(maxsize=8)
def _begins(counts: tuple[int, ...], device: torch.device) -> Tensor:
    """Return row pointers on the device, sent there once for calls that are alike."""
    return ptr_from_counts(list(counts), device=device)
