"""Readings that hang in the air between two surfaces."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.numbers import checked_count, checked_positive

_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # half of the eight: each pair of neighbors is compared once


@op(
    depth="V H W : depth",
    tolerance=partial(checked_positive, finite=False),
    min_neighbors=partial(checked_count, maximum=8),
    gradient=False,
)
def flying_pixel_mask(
    depth: Tensor,  # (V, H, W) float32 metres, 0 = no reading
    *,
    tolerance: float = 0.02,
    min_neighbors: int = 3,
    backend: str = "auto",
) -> Tensor:  # (V, H, W) bool, True = flying pixel
    """Mark readings beside a depth edge that share a surface with too few of their eight neighbors.

    Two neighbors share a surface if their depths differ by at most ``tolerance`` times the nearer one; two readings
    that do not lie across an edge from each other. Relative to depth, the slope of a surface gives the same difference
    at any distance: 0.02 bears one tilted by 85 degrees at 600 pixels focal length. Lines that are one pixel wide go as
    well (their pixels have two neighbors); a reading with nothing but holes around it stays.

    Args:
        depth: the images.
        tolerance: as a part of the depth; sensor noise of three standard deviations should fit in.
        min_neighbors: 1..8 neighbors that a good reading has on its surface.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ConfigError: a parameter out of range.
        CaptureError: a negative depth.
    """
    height, width = depth.shape[1:]
    on_surface = torch.zeros_like(depth, dtype=torch.uint8)
    at_edge = torch.zeros_like(depth, dtype=torch.bool)
    for down, across in _DIRECTIONS:
        if down >= height or abs(across) >= width:
            continue
        here = (..., slice(0, height - down), slice(max(0, -across), width - max(0, across)))
        there = (..., slice(down, height), slice(max(0, across), width - max(0, -across)))
        nearer = torch.minimum(depth[here], depth[there])
        both = nearer > 0
        same = both & ((depth[here] - depth[there]).abs() <= tolerance * nearer)
        edge = both & ~same
        for side in (here, there):
            on_surface[side] += same
            at_edge[side] |= edge
    return at_edge & (on_surface < min_neighbors)


@inner
def without_flying_pixels(
    depth: Tensor, confidence: Tensor | None, tolerance: float, min_neighbors: int
) -> tuple[Tensor, Tensor | None]:
    """Return depth (V, H, W) with 0 at its flying pixels, and its confidence (V, H, W) uint8, if any, as well."""
    flying = flying_pixel_mask(depth, tolerance=tolerance, min_neighbors=min_neighbors)
    marks = None if confidence is None else torch.where(flying, 0, confidence).to(torch.uint8)
    return torch.where(flying, 0.0, depth), marks
