"""Windows of pixels around points on a depth image: medians, and connected parts."""

from __future__ import annotations

import math

import torch
from torch import Tensor

import pcdata.functional.depth.flying_pixels
import pcdata.functional.image_clusters
import pcdata.functional.table_surface  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.radius import squared_radius
from pcdata.functional.rows import counts_from_ptr
from pcdata.kernels.cpu.native import call, room

# The core numbers the rows of one cloud with 31 bits.
_MAX_ROWS = 2**31 - 1


@kernel("flying_pixel_mask", "cpu")
def flying_pixel_mask(depth: Tensor, *, tolerance: float, min_neighbors: int) -> Tensor:
    """Compare each reading with its eight neighbors while walking over the rows once."""
    flying = room(depth.shape, torch.bool)
    call("pc_flying_pixels", depth, *depth.shape, float(tolerance), min_neighbors, flying)
    return flying


@kernel("without_flying_pixels", "cpu")
def without_flying_pixels(
    depth: Tensor, confidence: Tensor | None, tolerance: float, min_neighbors: int
) -> tuple[Tensor, Tensor | None]:
    """Write what is left instead of a mask."""
    kept, rule = room(depth.shape, torch.float32), (float(tolerance), min_neighbors)
    marks = None if confidence is None else room(depth.shape, torch.uint8)
    was = None if confidence is None else confidence.contiguous()
    unmasked = False, 0.0, math.inf, None
    call("pc_without_flying_pixels", depth.contiguous(), *depth.shape, *unmasked, *rule, was, kept, marks)
    return kept, marks


@kernel("window_medians", "cpu")
def window_medians(values: Tensor, points: Tensor, ptr: Tensor, grid: ImageGrid | None) -> Tensor:
    """Sort the nine values of many pixels side by side; without a grid the neighbors are those of knn."""
    if grid is None or values.dtype is not torch.float32:
        found: Tensor = INNER["window_medians"].reference(values, points, ptr, grid)
        return found
    medians = room(len(values), torch.float32)
    pixel = grid.pixel_index.contiguous()
    call("pc_window_medians", values.contiguous(), pixel, ptr.contiguous(), len(ptr) - 1, *grid.size, medians)
    return medians


@kernel("linked_pixels", "cpu")
def linked_pixels(
    points: Tensor, ptr: Tensor, pixel_index: Tensor, size: tuple[int, int], eps: float, reach: int
) -> Tensor:
    """Join the sets of linked rows while walking over the images once."""
    if len(points) and int(counts_from_ptr(ptr).max()) > _MAX_ROWS:
        found: Tensor = INNER["linked_pixels"].reference(points, ptr, pixel_index, size, eps, reach)
        return found
    label = room(len(points), torch.int64)
    arrays = points.contiguous(), pixel_index.contiguous(), ptr.contiguous(), len(ptr) - 1
    call("pc_linked_pixels", *arrays, *size, float(squared_radius(eps, points.device)), reach, label)
    return label
