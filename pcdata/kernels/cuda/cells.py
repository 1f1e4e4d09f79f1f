"""Points in cells so small that all points of one are neighbors, as ``core/pc/gpu/cell_table.hpp`` keeps them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.asked_later import is_set
from pcdata.functional.radius import cell_side, require_extent
from pcdata.kernels.cuda.launching import Launcher

MOST_ROWS = 2**29  # a table of four times as many places numbers them in 32 bits


class CellTable(NamedTuple):
    """A hash table of cells, and the points in their order; C places."""

    side: float
    places: Tensor  # (C,) int64: one row of each cell, and part of its hash
    counts: Tensor  # (C,) int32: points in each
    ends: Tensor  # (C,) int32: where they end among the placed points
    placed: Tensor  # (N, 4) float32: x, y, z and the bits of the row
    place_of: Tensor  # (N,) int32: the place of each row's cell
    listed: Tensor  # (N,) int32: the places of cells, in no fixed order; beyond their number nothing
    num_listed: Tensor  # (1,) int32: their number
    far: Tensor  # (1,) int32: not 0 where a point lies so far out that its cell is not certain

    @property
    def mask(self) -> int:
        """The number of places, less 1."""
        return len(self.places) - 1


def cell_table(launcher: Launcher, points: Tensor, ptr: Tensor, radius: float, needed: Tensor) -> CellTable:
    """Sort points into cells for a radius; all kernels do nothing where ``needed`` (1,) int32 is 0."""
    rows, clouds, device = len(points), len(ptr) - 1, points.device
    side = cell_side(radius)
    size = num_places(rows)
    places = torch.zeros(size, dtype=torch.int64, device=device)
    counts = torch.zeros(size, dtype=torch.int32, device=device)
    num_listed, far = torch.zeros((2, 1), dtype=torch.int32, device=device).unbind()
    place_of, rank_of, listed = torch.empty((3, rows), dtype=torch.int32, device=device).unbind()
    launcher.launch(
        "pc_insert_cells",
        *(rows, points, ptr, clouds, rows, side, places, size - 1),
        *(needed, place_of, rank_of, counts, listed, num_listed, far),
    )
    ends = counts.cumsum(0, dtype=torch.int32)
    placed = torch.empty((rows, 4), dtype=torch.float32, device=device)
    launcher.launch("pc_place_points", rows, points, ptr, clouds, rows, needed, place_of, rank_of, counts, ends, placed)
    return CellTable(side, places, counts, ends, placed, place_of, listed, num_listed, far)


def num_places(rows: int) -> int:
    """Return how many places a table has for cells of so many rows: at most half of them are taken."""
    return 1 << max(4, (2 * rows - 1).bit_length())


def hold_to_extent(where: str, points: Tensor, ptr: Tensor, radius: float, far: Tensor) -> None:
    """Refuse clouds too large for their cells, as the reference does; the one wait for the device, if not put off.

    Raises:
        ConfigError: a cloud is more than 2^36 cells wide.
    """
    if is_set(far):
        require_extent(where, points, ptr, radius)
