"""Masks of points in one pass: boxes, polygons, repeats; the hull of points in a plane."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pcdata.contracts.dispatch import OPERATIONS, kernel
from pcdata.functional.plane_patch import flat_places
from pcdata.functional.selection import require_box
from pcdata.kernels.cpu.native import call, room

# The core numbers the rows of one cloud with 31 bits.
_MAX_ROWS = 2**31 - 1
_MOST_CELLS = 512 * 512  # of a plane


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
    corners, number = room(len(points), torch.int64), room(1, torch.int64)
    call("pc_convex_hull", points.contiguous(), len(points), corners, number)
    return corners[: int(number)].clone()


@kernel("patch_cells", "cpu")
def patch_cells(
    points: Tensor, near: Tensor, plane: Tensor, axes: Tensor, distance: float
) -> tuple[Tensor, float, Tensor]:
    """Count points in cells, and join these, in one call."""
    size, numbers, cells = room(2, torch.int64), room(3, torch.float64), room(_MOST_CELLS, torch.bool)
    given = points.contiguous(), near.contiguous(), len(points), plane.contiguous(), axes, float(distance)
    call("pc_patch_cells", *given, size, numbers, cells)
    height, width = size.tolist()
    if height < 0:  # the reference says so
        found: tuple[Tensor, float, Tensor] = OPERATIONS["patch_cells"].reference(points, near, plane, axes, distance)
        return found
    return numbers[:2], float(numbers[2]), cells[: height * width].reshape(height, width)


@kernel("points_in_cells", "cpu")
def points_in_cells(points: Tensor, chosen: Tensor, axes: Tensor, low: Tensor, scale: float, cells: Tensor) -> Tensor:
    """Number the cells of chosen points in one pass."""
    inside = room(len(points), torch.bool)
    height, width = cells.shape
    arrays = points.contiguous(), chosen, len(points), axes, low, float(scale), cells.contiguous(), height, width
    call("pc_points_in_cells", *arrays, inside)
    return inside


@kernel("outline_rows", "cpu")
def outline_rows(points: Tensor, chosen: Tensor, plane: Tensor, axes: Tensor) -> tuple[Tensor, float]:
    """Leave out what is well inside of a polygon, in the pass that sums squares; few points are left."""
    points, rows = points.contiguous(), room(len(points), torch.int64)
    number, squares = room(1, torch.int64), room(1, torch.float64)
    call("pc_outline_points", points, chosen, len(points), plane.contiguous(), axes, rows, number, squares)
    rows = rows[: int(number)]
    corners = rows[hull_rows(flat_places(points[rows], axes))]
    return corners, math.sqrt(float(squares) / max(1, int(chosen.count_nonzero())))
