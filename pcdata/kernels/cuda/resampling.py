"""Depth images of another size."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

import pcdata.functional.depth.resampling  # noqa: F401 - the operations must be registered before their kernels
from pcdata.contracts.dispatch import OPERATIONS, kernel
from pcdata.kernels.cuda.launching import launcher_of


@kernel("decimate_depth", "cuda")
def decimate_depth(
    depth: Tensor, *, factor: int, rule: Literal["median", "mean"], max_jump: float
) -> tuple[Tensor, Tensor]:
    """Rank the readings of every block."""
    views, height, width = depth.shape
    size = views, height // factor, width // factor
    if 0 in size[1:]:
        refused: tuple[Tensor, Tensor] = OPERATIONS["decimate_depth"].reference(
            depth, factor=factor, rule=rule, max_jump=max_jump
        )
        return refused
    reduced = torch.empty(size, dtype=torch.float32, device=depth.device)
    pixel_index = torch.empty(size, dtype=torch.int64, device=depth.device)
    given = depth, *depth.shape, factor, int(rule == "mean"), max_jump
    launcher_of(depth).launch("pc_decimate_depth", reduced.numel(), *given, reduced, pixel_index)
    return reduced, pixel_index


@kernel("resize_depth", "cuda")
def resize_depth(depth: Tensor, *, size: tuple[int, int], max_jump: float | None) -> tuple[Tensor, Tensor]:
    """Look at the pixels around every new center."""
    views, height, width = depth.shape
    if 0 in (height, width):
        refused: tuple[Tensor, Tensor] = OPERATIONS["resize_depth"].reference(depth, size=size, max_jump=max_jump)
        return refused
    resized = torch.empty((views, *size), dtype=torch.float32, device=depth.device)
    pixel_index = torch.empty((views, *size), dtype=torch.int64, device=depth.device)
    given = depth, *depth.shape, *size, height / size[0], width / size[1], -1.0 if max_jump is None else max_jump
    launcher_of(depth).launch("pc_resize_depth", resized.numel(), *given, resized, pixel_index)
    return resized, pixel_index
