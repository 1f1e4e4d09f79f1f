"""Kernels of random numbers per row: points moved and jittered in one pass, and rows chosen at random."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

import pcdata.functional.noise  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.functional.noise import PointStep
from pcdata.kernels.cpu.native import call, numbers, room, room_for


@kernel("move_points", "cpu")
def move_points(
    points: Tensor,
    ptr: Tensor,
    steps: Sequence[PointStep],
    kept: tuple[Tensor, Tensor] | None = None,
    *,
    in_place: bool = False,
) -> Tensor:
    """Take every point through all steps while it is in the cache."""
    fits = points.dtype is torch.float32 and points.shape[1:] == (3,) and len(ptr) > 1 and int(ptr[-1]) == len(points)
    if not fits or not steps or int(ptr[0]) != 0 or (in_place and not points.is_contiguous()):
        return INNER["move_points"].reference(points, ptr, steps, kept, in_place=in_place)
    mask, kept_ptr = (None, None) if kept is None else kept
    count = len(points) if kept_ptr is None else int(kept_ptr[-1])
    moved = points if kept_ptr is None else points[:count]
    if not in_place:
        (moved,) = room_for(((count, 3), points.dtype))
    _run(points.contiguous(), ptr, steps, (mask, kept_ptr), moved)
    return moved


def _run(
    points: Tensor,
    ptr: Tensor,
    steps: Sequence[PointStep],
    kept: tuple[Tensor | None, Tensor | None],
    moved: Tensor,
) -> None:
    clouds = len(ptr) - 1
    matrices = torch.zeros((len(steps), clouds, 4, 4), dtype=torch.float64, device="cpu")
    seeds = torch.zeros((len(steps), clouds), dtype=torch.int64, device="cpu")
    sigmas, clips = [], []
    for number, step in enumerate(steps):
        if isinstance(step, Tensor):
            matrices[number], sigma, clip = step, 0.0, None
        else:
            seeds[number], sigma, clip = step
        sigmas.append(sigma)
        clips.append(math.inf if clip is None else clip)
    call(
        "pc_move_points",
        *(points, ptr.contiguous(), clouds, len(steps)),
        *(numbers(not isinstance(step, Tensor) for step in steps), matrices, seeds),
        *(torch.tensor(values, dtype=torch.float64, device="cpu") for values in (sigmas, clips)),
        *(*kept, moved),
    )


@kernel("random_rows", "cpu")
def random_rows(counts: Tensor, wanted: Tensor, seeds: Tensor) -> Tensor:
    """Draw until there are enough."""
    mask = room(int(counts.sum()), torch.bool)
    call("pc_random_rows", len(counts), counts.contiguous(), wanted.contiguous(), seeds.contiguous(), mask)
    return mask
