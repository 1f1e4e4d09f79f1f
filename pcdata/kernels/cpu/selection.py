"""Masks of points in one pass: boxes, polygons, repeats; the hull of points in a plane."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.dispatch import OPERATIONS, kernel
from pcdata.functional.selection import require_box
from pcdata.kernels.cpu.native import answers, call, room

# The core numbers the rows of one cloud with 31 bits.
_MAX_ROWS = 2**31 - 1


@kernel("box_mask", "cpu")
def box_mask(*, points: Tensor, ptr: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Compare all clouds, each with its own box."""
    require_box(lower, upper)
    inside = room(len(points), torch.bool)
    corners = lower.float().contiguous(), upper.float().contiguous()
    call("pc_box_mask", points, ptr, len(ptr) - 1, *corners, inside)
    return inside


@kernel("polygon_mask", "cpu")
def polygon_mask(*, points: Tensor, polygon: Tensor) -> Tensor:
    """Take blocks of points along all edges."""
    inside = room(len(points), torch.bool)
    call("pc_polygon_mask", points, len(points), polygon.contiguous(), len(polygon), inside)
    return inside


@kernel("duplicate_mask", "cpu")
def duplicate_mask(*, points: Tensor, ptr: Tensor) -> Tensor:
    """Number the different points of each cloud in a hash table."""
    if len(points) > _MAX_ROWS:
        found: Tensor = OPERATIONS["duplicate_mask"].reference(points, ptr)
        return found
    repeats = room(len(points), torch.bool)
    call("pc_duplicate_mask", points, ptr, len(ptr) - 1, repeats)
    return repeats


@kernel("hull_rows", "cpu")
def hull_rows(points: Tensor) -> Tensor:
    """Divide edges like the reference, with one pass over the points outside of each."""
    corners, number = room(len(points), torch.int64), answers()
    call("pc_convex_hull", points.contiguous(), len(points), corners, number)
    return corners[: number[0]].clone()
