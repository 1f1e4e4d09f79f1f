"""What the searches of the compiled core take: points, limits, and where the points lie in their depth images."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.radius import largest_squared

# The core keeps rows, and numbers of neighbors, in 31 bits.
MAX_ROWS = 2**31 - 1


def core_rows(points: Tensor, ptr: Tensor) -> tuple[Tensor, Tensor]:
    """Return points and row pointers as the core reads them.

    Raises:
        ValueError: there are more points than it can number.
    """
    if points.shape[0] > MAX_ROWS:
        raise ValueError(f"the compiled core takes at most {MAX_ROWS} points in a call, got {points.shape[0]}")
    return (points.detach() if points.requires_grad else points).contiguous(), ptr.contiguous()


def reachable(count: int, points: Tensor) -> int:
    """Return a number of neighbors that gives the same answer and fits the 31 bits of the core."""
    return min(count, max(1, points.shape[0]))


@functools.lru_cache(maxsize=256)
def limit_of(radius: float | None) -> float:
    """Return the largest squared distance of neighbors within a radius."""
    return float(largest_squared(radius, torch.device("cpu")))


def limits_of(radius: float | Tensor | None) -> tuple[float, Tensor | None]:
    """Return the limit of squared distances of all queries, and those of each where they have radii of their own."""
    if isinstance(radius, Tensor):
        return 0.0, largest_squared(radius, radius.device).contiguous()
    return limit_of(radius), None


def grid_arguments(grid: ImageGrid | None) -> tuple[Tensor | None, int, Tensor | None]:
    """Return what the core wants of a grid: pixels, width, motions into the cameras' frames."""
    if grid is None:
        return None, 0, None
    motion = grid.camera_from_points
    return (
        grid.pixel_index.contiguous(),
        grid.size[1],
        None if motion is None else motion.detach().double().contiguous(),
    )
