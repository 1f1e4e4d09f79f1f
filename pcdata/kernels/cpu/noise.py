"""Kernels of random numbers per row: points moved and jittered in one pass, and rows chosen at random."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

import pcdata.functional.noise  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.functional.noise import PointStep
from pcdata.kernels.cpu.native import call, room, room_for

_MAX_ROWS = 2**32 - 1  # of one cloud; the core numbers them with 32 bits


@kernel("move_points", "cpu")
def move_points(
    points: Tensor,
    ptr: Tensor,
    steps: Sequence[PointStep],
    kept: tuple[Tensor, Tensor] | None = None,
    *,
    in_place: bool = False,
    sources: Tensor | None = None,
) -> Tensor:
    """Take every point through all steps while it is in the cache."""
    fits = points.dtype is torch.float32 and points.shape[1:] == (3,) and len(ptr) > 1 and int(ptr[-1]) == len(points)
    in_place = in_place or sources is not None
    if not fits or not steps or int(ptr[0]) != 0 or (in_place and not points.is_contiguous()):
        return INNER["move_points"].reference(points, ptr, steps, kept, in_place=in_place, sources=sources)
    mask, kept_ptr = (None, None) if kept is None else kept
    count = len(points) if kept_ptr is None else int(kept_ptr[-1])
    moved = points if kept_ptr is None else points[:count]
    if not in_place:
        (moved,) = room_for(((count, 3), points.dtype))
    _run(points.contiguous(), sources, ptr, steps, (mask, kept_ptr), moved)
    return moved


def _run(
    points: Tensor,
    sources: Tensor | None,
    ptr: Tensor,
    steps: Sequence[PointStep],
    kept: tuple[Tensor | None, Tensor | None],
    moved: Tensor,
) -> None:
    clouds = len(ptr) - 1
    matrices, seeds = np.zeros((len(steps), clouds, 4, 4)), np.zeros((len(steps), clouds), np.int64)
    noises, sigmas, clips = np.zeros(len(steps), np.int64), np.zeros(len(steps)), np.full(len(steps), np.inf)
    for number, step in enumerate(steps):
        if isinstance(step, Tensor):
            matrices[number] = step.numpy(force=True)
        else:
            noises[number], sigmas[number] = 1, step[1]
            seeds[number] = step[0].numpy(force=True)
            if step[2] is not None:
                clips[number] = step[2]
    call(
        "pc_move_points",
        *(points, sources, ptr.contiguous(), clouds, len(steps)),
        *map(torch.from_numpy, (noises, matrices, seeds, sigmas, clips)),
        *(*kept, moved),
    )


@kernel("random_order", "cpu")
def random_order(counts: Tensor, wanted: Tensor, seeds: Tensor) -> Tensor:
    """Sort cloud by cloud; of a cloud of which few are wanted, those alone that may come first."""
    if len(counts) and int(counts.max()) >= _MAX_ROWS:
        return INNER["random_order"].reference(counts, wanted, seeds)
    rows = room(int(wanted.sum()), torch.int64)
    call("pc_random_order", len(counts), counts.contiguous(), wanted.contiguous(), seeds.contiguous(), rows)
    return rows


@kernel("dropped_rows", "cpu")
def dropped_rows(keys: Tensor, ptr: Tensor, low: float, high: float) -> tuple[Tensor, Tensor]:
    """Draw the part and the rows of one cloud after another."""
    mask, kept_ptr = room(int(ptr[-1]), torch.bool), room(ptr.shape, torch.int64)
    call("pc_dropped_rows", keys, ptr.contiguous(), ptr.shape[0] - 1, low, high, mask, kept_ptr)
    return mask, kept_ptr
