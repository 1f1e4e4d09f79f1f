"""Holes of depth images: filled along rows, or inwards from their rims, a layer at a time, in one launch."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

import pcdata.functional.depth.confidence  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, OPERATIONS, kernel
from pcdata.functional.depth.holes import wide_holes
from pcdata.kernels.cuda.launching import BLOCK, launcher_of

_MOST_PIXELS = 2**31 - 8  # numbered with 31 bits, and so are layers


@kernel("fill_holes", "cuda")
def fill_holes(
    depth: Tensor, *, rule: Literal["left", "farthest", "nearest"], max_size: int | None
) -> tuple[Tensor, Tensor]:
    """Write the distances as well."""
    if depth.numel() > _MOST_PIXELS:
        reference: tuple[Tensor, Tensor] = OPERATIONS["fill_holes"].reference(depth, rule=rule, max_size=max_size)
        return reference
    filled, layers = _filled(depth, rule, max_size)
    distance = torch.empty(depth.shape, dtype=torch.int64, device=depth.device)
    launcher_of(depth).launch("pc_tell_distances", depth.numel(), depth.numel(), layers, 0, distance, None)
    return filled, distance


@kernel("filled_images", "cuda")
def filled_images(
    depth: Tensor, rule: Literal["left", "farthest", "nearest"], max_size: int | None, max_distance: int
) -> tuple[Tensor, Tensor]:
    """Write the mask, not the distances, which are eight times its size."""
    if depth.numel() > _MOST_PIXELS:
        reference: tuple[Tensor, Tensor] = INNER["filled_images"].reference(depth, rule, max_size, max_distance)
        return reference
    filled, layers = _filled(depth.contiguous(), rule, max_size)
    far = torch.empty(depth.shape, dtype=torch.bool, device=depth.device)
    launcher_of(depth).launch("pc_tell_distances", depth.numel(), depth.numel(), layers, max_distance, None, far)
    return filled, far


@kernel("fill_rows", "cuda")
def fill_rows(values: Tensor, radius: int) -> Tensor:
    """Look to the left of every gap's pixels, then to the right."""
    filled = torch.empty(values.shape, dtype=torch.float32, device=values.device)
    given = values.contiguous(), values.numel(), values.shape[2], radius
    launcher_of(values).launch("pc_fill_gaps", values.numel(), *given, filled)
    return filled


@kernel("filled_confidence", "cuda")
def filled_confidence(
    before: Tensor, after: Tensor, confidence: Tensor | None, hallucinated: Tensor | None
) -> Tensor | None:
    """Look at every pixel once; the host waits only where there was no confidence before."""
    found = torch.empty(before.shape, dtype=torch.uint8, device=before.device)
    any_filled = torch.zeros(1, dtype=torch.int32, device=before.device)
    marks = (None if image is None else image.contiguous() for image in (confidence, hallucinated))
    given = before.contiguous(), after.contiguous(), before.numel(), *marks
    launcher_of(before).launch("pc_trust_filled", before.numel(), *given, found, any_filled)
    return None if confidence is None and not int(any_filled) else found


def _filled(depth: Tensor, rule: str, max_size: int | None) -> tuple[Tensor, Tensor]:
    """Return filled depth, and the layer or column (V, H, W) int32 of every pixel that was filled."""
    launcher, device, count = launcher_of(depth), depth.device, depth.numel()
    wide = None if max_size is None else wide_holes(depth == 0, max_size + 1)
    filled = torch.empty(depth.shape, dtype=torch.float32, device=device)
    layers = torch.empty(depth.shape, dtype=torch.int32, device=device)
    if rule == "left":
        launcher.launch("pc_fill_from_left", count, depth, count, depth.shape[2], wide, filled, layers)
        return filled, layers
    queue = torch.empty(count, dtype=torch.int32, device=device)
    numbers = torch.zeros(4, dtype=torch.int32, device=device)
    counts, arrivals = numbers[:3], numbers[3:]
    size, state = depth.shape[1:], (filled, layers, queue, counts)
    launcher.launch("pc_begin_filling", count, depth, count, *size, wide, *state)
    blocks = min(launcher.resident_blocks("pc_fill_layers"), -(-count // BLOCK))
    launcher.launch_blocks("pc_fill_layers", blocks, *size, int(rule == "farthest"), *state, arrivals)
    return filled, layers
