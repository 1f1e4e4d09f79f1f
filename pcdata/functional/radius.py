"""Which points lie within a radius, and how small a radius may be against a cloud: one rule for every backend.

The test is ``d2 < float32(radius) * float32(radius)``, strict.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pcdata.errors import ConfigError
from pcdata.functional.rows import counts_from_ptr, segment_max, segment_min

# Faster backends cut a cloud into cells whose points are all neighbors: the diagonal of a cell is just under the
# radius, by far more than float32 distances (2e-7) and cell borders (2e-6) can err.
_MARGIN = 1e-4
# Up to here a float64 cell coordinate errs by less than 2^-16 of a cell, and (column, coordinate) fits in 64 bits.
_MAX_CELLS_PER_AXIS = 2**36


def squared_radius(radius: float | Tensor | None, device: torch.device) -> Tensor:
    """Return the () or (Q,) float32 that d2 of a neighbor is below; infinite when there is no radius."""
    if not isinstance(radius, Tensor):
        radius = torch.full((), math.inf if radius is None else radius, dtype=torch.float32, device=device)
    return radius * radius


def largest_squared(radius: float | Tensor | None, device: torch.device) -> Tensor:
    """Return the largest float32 d2 that counts as d < radius; a finite maximum when there is no radius."""
    limit = squared_radius(radius, device)
    return torch.nextafter(limit, torch.zeros_like(limit))


def cell_side(radius: float) -> float:
    """Return the side of cells so small that all points in one are within the radius of each other."""
    return float(torch.tensor(radius, dtype=torch.float32, device="cpu")) / math.sqrt(3.0) * (1 - _MARGIN)


def require_cells(where: str, radius: float, largest: float) -> None:
    """Require that the largest cell coordinate of a cloud is one that cells can have.

    Raises:
        ConfigError: a cloud is more than 2^36 cells wide.
    """
    if largest >= _MAX_CELLS_PER_AXIS:
        raise ConfigError(
            f"{where}: a radius of {radius:g} cuts a cloud into {largest:.2g} cells along an axis, "
            f"more than {_MAX_CELLS_PER_AXIS:.2g}; are both in the same unit, or is a stray point far out?"
        )


def require_extent(where: str, points: Tensor, ptr: Tensor, radius: float) -> None:
    """Hold every cloud to :func:`require_cells`."""
    extent = (segment_max(points, ptr).double() - segment_min(points, ptr))[counts_from_ptr(ptr) > 0]
    if len(extent):
        require_cells(where, radius, float(extent.max()) / cell_side(radius))
