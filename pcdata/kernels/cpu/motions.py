"""Kernels of motions: all that a batch draws in one call, and the way back through them in another."""

from __future__ import annotations

import torch
from torch import Tensor

import pcdata.functional.motions  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.kernels.cpu.native import answers, call, room


@kernel("draw_motions", "cpu")
def draw_motions(keys: Tensor, draws: Tensor, num_steps: int) -> Tensor:
    """Draw cloud by cloud."""
    clouds = keys.shape[0]
    matrices = room((num_steps, clouds, 4, 4), torch.float64)
    call("pc_draw_motions", keys, clouds, draws, draws.shape[0], num_steps, matrices)
    return matrices


@kernel("led_back", "cpu")
def led_back(source_from_cloud: Tensor, matrices: Tensor) -> Tensor:
    """Invert one matrix after another; LU, where it is called for, is torch's."""
    steps, clouds = matrices.shape[:2]
    result, possible = room(source_from_cloud.shape, torch.float64), answers()
    call("pc_led_back", matrices.contiguous(), steps, clouds, source_from_cloud.contiguous(), result, possible)
    if not possible[0]:
        back: Tensor = INNER["led_back"].reference(source_from_cloud, matrices)
        return back
    return result


@kernel("are_plain_motions", "cpu")
def are_plain_motions(matrices: Tensor) -> bool:
    """Look at one after another."""
    plain = answers()
    call("pc_are_plain_motions", matrices.contiguous(), matrices.numel() // 16, plain)
    return bool(plain[0])
