"""Filters of depth images: averages along rows and columns and over time, windows of pixels, holes."""

from __future__ import annotations

import torch
from torch import Tensor

import pcdata.functional.depth.confidence  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, OPERATIONS, kernel
from pcdata.functional.depth.disparity import smallest_edge
from pcdata.functional.depth.holes import RULES
from pcdata.functional.depth.temporal import PERSISTENCE_RULES
from pcdata.functional.depth.window_filters import depth_scale, pixel_shares
from pcdata.kernels.cpu.native import answers, call, room

# The core numbers pixels with 31 bits, and those of a border of one pixel around the images too.
_MAX_PIXELS = 2**31 - 1


@kernel("reciprocals", "cpu")
def reciprocals(values: Tensor, scale: Tensor) -> Tensor:
    """Divide with all threads."""
    if values.dtype is not torch.float32:
        found: Tensor = INNER["reciprocals"].reference(values, scale)
        return found
    divided = room(values.shape, torch.float32)
    call("pc_reciprocals", values.contiguous(), scale.contiguous(), len(values), values[:1].numel(), divided)
    return divided


@kernel("smoothed_images", "cpu")
def smoothed_images(values: Tensor, scale: Tensor | None, alpha: float, delta: float, iterations: int) -> Tensor:
    """Go along 32 rows, and along 128 columns, side by side."""
    smoothed = room(values.shape, torch.float32)
    rule = 1 - alpha, smallest_edge(delta), iterations
    call("pc_spatial_filter", values.contiguous(), scale, *values.shape, *rule, smoothed)
    return smoothed


@kernel("temporal_step", "cpu")
def temporal_step(
    values: Tensor,
    scale: Tensor | None,
    last: Tensor,
    history: Tensor,
    alpha: float,
    delta: float,
    persistence: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Look at every pixel once."""
    filtered, new_last = (room(values.shape, torch.float32) for _ in range(2))
    seen = room(values.shape, torch.uint8)
    arrays = values.contiguous(), scale, len(values), values[:1].numel()
    rule = 1 - alpha, float(delta), *PERSISTENCE_RULES[persistence]
    call("pc_temporal_filter", *arrays, *rule, last.contiguous(), history.contiguous(), filtered, new_last, seen)
    return filtered, new_last, seen


@kernel("bilateral_filter", "cpu")
def bilateral_filter(depth: Tensor, *, reach: int, sigma_pixels: float, sigma_depth: float, max_jump: float) -> Tensor:
    """Look at the windows of many pixels side by side."""
    shares = torch.tensor(pixel_shares(reach, sigma_pixels), dtype=torch.float32, device="cpu")
    smoothed = room(depth.shape, torch.float32)
    call("pc_bilateral_filter", depth, *depth.shape, reach, shares, depth_scale(sigma_depth), float(max_jump), smoothed)
    return smoothed


@kernel("median_filter", "cpu")
def median_filter(depth: Tensor, *, reach: int, max_jump: float | None) -> Tensor:
    """Sort the windows of many pixels side by side."""
    medians = room(depth.shape, torch.float32)
    call("pc_median_filter", depth, *depth.shape, reach, -1.0 if max_jump is None else float(max_jump), medians)
    return medians


@kernel("fill_holes", "cpu")
def fill_holes(depth: Tensor, *, rule: str, max_size: int | None) -> tuple[Tensor, Tensor]:
    """Go inwards from the rims with two queues of pixels."""
    if _too_many(depth):
        reference: tuple[Tensor, Tensor] = OPERATIONS["fill_holes"].reference(depth, rule=rule, max_size=max_size)
        return reference
    filled, distance = room(depth.shape, torch.float32), room(depth.shape, torch.int64)
    call("pc_fill_holes", depth, *depth.shape, RULES.index(rule), max_size or 0, filled, distance, 0, None)
    return filled, distance


@kernel("filled_images", "cpu")
def filled_images(depth: Tensor, rule: str, max_size: int | None, max_distance: int) -> tuple[Tensor, Tensor]:
    """Write the mask, not the distances, which are eight times its size."""
    if _too_many(depth):
        reference: tuple[Tensor, Tensor] = INNER["filled_images"].reference(depth, rule, max_size, max_distance)
        return reference
    filled, far = room(depth.shape, torch.float32), room(depth.shape, torch.bool)
    given = depth.contiguous(), *depth.shape, RULES.index(rule), max_size or 0
    call("pc_fill_holes", *given, filled, None, max_distance, far)
    return filled, far


@kernel("fill_rows", "cpu")
def fill_rows(values: Tensor, radius: int) -> Tensor:
    """Go along every row, and back."""
    filled = room(values.shape, torch.float32)
    views, height, width = values.shape
    call("pc_fill_rows", values.contiguous(), views * height, width, radius, filled)
    return filled


@kernel("filled_confidence", "cpu")
def filled_confidence(
    before: Tensor, after: Tensor, confidence: Tensor | None, hallucinated: Tensor | None
) -> Tensor | None:
    """Look at every pixel once."""
    found, any_filled = room(before.shape, torch.uint8), answers()
    marks = (None if image is None else image.contiguous() for image in (confidence, hallucinated))
    call("pc_filled_confidence", before.contiguous(), after.contiguous(), before.numel(), *marks, found, any_filled)
    return None if confidence is None and not any_filled[0] else found


def _too_many(depth: Tensor) -> bool:
    views, height, width = depth.shape
    return views * (height + 2) * (width + 2) > _MAX_PIXELS
