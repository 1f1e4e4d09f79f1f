"""Filters of depth images: averages along lines and over time, windows of pixels, what flies."""

from __future__ import annotations

import torch
from torch import Tensor

import pcdata.functional.depth.flying_pixels
import pcdata.functional.depth.temporal
import pcdata.functional.depth.window_filters  # noqa: F401 - functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.contracts.on_host import uploaded
from pcdata.functional.depth.disparity import LINE_HOLE, smallest_edge
from pcdata.functional.depth.temporal import PERSISTENCE_RULES
from pcdata.functional.depth.window_filters import depth_scale, pixel_shares
from pcdata.kernels.cuda.launching import launcher_of


@kernel("reciprocals", "cuda")
def reciprocals(values: Tensor, scale: Tensor) -> Tensor:
    """Divide in one pass."""
    if values.dtype is not torch.float32 or scale.dtype is not torch.float32:
        found: Tensor = INNER["reciprocals"].reference(values, scale)
        return found
    return _read(values, scale, 0.0)


@kernel("smoothed_images", "cuda")
def smoothed_images(values: Tensor, scale: Tensor | None, alpha: float, delta: float, iterations: int) -> Tensor:
    """Go along all columns, or all rows, side by side, with a thread for each; neighbors lie beside each other."""
    if values.numel() == 0:
        return torch.empty_like(values, memory_format=torch.contiguous_format)
    launcher, (views, height, width) = launcher_of(values), values.shape
    rows = _read(values, scale, LINE_HOLE).permute(1, 0, 2).contiguous()  # (H, V, W)
    rule = 1 - alpha, smallest_edge(delta)
    for _ in range(iterations):
        columns = rows.permute(2, 1, 0).contiguous()
        launcher.launch("pc_average_lines", views * height, columns, width, views * height, *rule)
        rows = columns.permute(2, 1, 0).contiguous()
        launcher.launch("pc_average_lines", views * width, rows, height, views * width, *rule)
    return _read(rows.permute(1, 0, 2), scale, 0.0)


@kernel("temporal_step", "cuda")
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
    filtered, new_last = (torch.empty(values.shape, dtype=torch.float32, device=values.device) for _ in range(2))
    seen = torch.empty(values.shape, dtype=torch.uint8, device=values.device)
    given = values.contiguous(), values.numel(), None if scale is None else scale.contiguous(), _pixels(values)
    rule = 1 - alpha, delta, *PERSISTENCE_RULES[persistence]
    memory = last.contiguous(), history.contiguous(), filtered, new_last, seen
    launcher_of(values).launch("pc_average_over_time", values.numel(), *given, *rule, *memory)
    return filtered, new_last, seen


@kernel("bilateral_filter", "cuda")
def bilateral_filter(depth: Tensor, *, reach: int, sigma_pixels: float, sigma_depth: float, max_jump: float) -> Tensor:
    """Look at the window of every pixel."""
    shares = torch.tensor(pixel_shares(reach, sigma_pixels), dtype=torch.float32, device="cpu")
    smoothed = torch.empty_like(depth)
    rule = reach, uploaded(shares, depth.device), depth_scale(sigma_depth), max_jump
    launcher_of(depth).launch("pc_average_windows", depth.numel(), depth, *depth.shape, *rule, smoothed)
    return smoothed


@kernel("median_filter", "cuda")
def median_filter(depth: Tensor, *, reach: int, max_jump: float | None) -> Tensor:
    """Count, for the readings of every window, how many are nearer."""
    medians = torch.empty_like(depth)
    rule = reach, -1.0 if max_jump is None else max_jump
    launcher_of(depth).launch("pc_find_medians", depth.numel(), depth, *depth.shape, *rule, medians)
    return medians


@kernel("flying_pixel_mask", "cuda")
def flying_pixel_mask(depth: Tensor, *, tolerance: float, min_neighbors: int) -> Tensor:
    """Compare each reading with its eight neighbors."""
    flying = torch.empty(depth.shape, dtype=torch.bool, device=depth.device)
    rule = tolerance, min_neighbors
    launcher_of(depth).launch("pc_mark_flying", depth.numel(), depth, *depth.shape, *rule, flying)
    return flying


@kernel("without_flying_pixels", "cuda")
def without_flying_pixels(
    depth: Tensor, confidence: Tensor | None, tolerance: float, min_neighbors: int
) -> tuple[Tensor, Tensor | None]:
    """Write what is left instead of a mask."""
    kept = torch.empty(depth.shape, dtype=torch.float32, device=depth.device)
    marks = None if confidence is None else torch.empty(depth.shape, dtype=torch.uint8, device=depth.device)
    given = depth.contiguous(), *depth.shape, tolerance, min_neighbors
    was = None if confidence is None else confidence.contiguous()
    launcher_of(depth).launch("pc_drop_flying", depth.numel(), *given, was, kept, marks)
    return kept, marks


def _read(values: Tensor, scale: Tensor | None, none: float) -> Tensor:
    """Return values, or scale / value, and `none` where there is no reading."""
    read = torch.empty(values.shape, dtype=torch.float32, device=values.device)
    given = values.contiguous(), values.numel(), None if scale is None else scale.contiguous(), _pixels(values), none
    launcher_of(values).launch("pc_read_values", values.numel(), *given, read)
    return read


def _pixels(images: Tensor) -> int:
    return images.shape[1] * images.shape[2]
