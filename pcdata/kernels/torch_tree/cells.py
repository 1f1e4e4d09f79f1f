"""Cells so small that all points in one are neighbors: what makes counting and clustering cheap.

A cell's side is the radius over sqrt(3), so its diagonal is just under the radius. Only occupied cells exist.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.functional.radius import cell_side, require_cells
from pcdata.functional.rows import cloud_of_rows, group_count
from pcdata.kernels.torch_tree.boxtree import expand_ranges

_REACH = 2  # ceil(sqrt(3)), and a margin: neighbors within the radius are at most two cells away on every axis


@dataclass(frozen=True)
class Cells:
    """The occupied cells of a ragged batch, numbered by (cloud, x, y, z).

    Keys nest, (cloud, x) then (that, y) then (that, z), each level numbered from 0, so that no key overflows however
    large the scene is against the radius.
    """

    cell: Tensor  # (N,) int64, the cell of every point
    count: Tensor  # (C,) int64, points in every cell
    keys: tuple[Tensor, Tensor, Tensor]  # sorted, unique; a parent's number times span + coordinate
    spans: tuple[int, int, int]

    @classmethod
    def within(cls, where: str, points: Tensor, ptr: Tensor, radius: float) -> Cells:
        """Put (N,3) points into cells whose points all lie within ``radius`` of each other.

        Raises:
            ConfigError: a cloud is more than 2^36 cells wide.
        """
        cloud = cloud_of_rows(ptr)
        index = cloud[:, None].expand(-1, 3)
        low = points.new_full((len(ptr) - 1, 3), torch.inf).scatter_reduce_(0, index, points, "amin").double()
        scaled = (points - low[cloud]) / cell_side(radius)
        largest: list[float] = scaled.amax(0).tolist() if len(points) else [0.0, 0.0, 0.0]
        require_cells(where, radius, max(largest))
        # Room of _REACH on both sides, so that a neighbor's coordinate never runs into the next column.
        coordinate = scaled.long() + _REACH
        spans = tuple(int(most) + 2 * _REACH + 1 for most in largest)
        number, keys = cloud, []
        for axis, span in zip(coordinate.unbind(1), spans):
            unique, number = torch.unique(number * span + axis, return_inverse=True)
            keys.append(unique)
        count = group_count(number, len(keys[2]))
        return cls(number, count, (keys[0], keys[1], keys[2]), (spans[0], spans[1], spans[2]))

    def __len__(self) -> int:
        return len(self.count)

    def crowd(self) -> Tensor:
        """Return (N,) int64: the points in every point's cell, itself included."""
        return self.count[self.cell]

    def neighbor_pairs(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield every pair of cells that may hold points within the radius, once, nearest cells first."""
        yz, z = self.keys[2] // self.spans[2], self.keys[2] % self.spans[2]
        x, y = self.keys[1][yz] // self.spans[1], self.keys[1][yz] % self.spans[1]
        every = torch.arange(len(self), dtype=torch.int64, device=z.device)
        columns = [(dx, dy) for dx in range(_REACH + 1) for dy in range(-_REACH, _REACH + 1) if (dx, dy) >= (0, 0)]
        for dx, dy in sorted(columns, key=lambda step: step[0] ** 2 + step[1] ** 2):
            column, found = _find(self.keys[0], self.keys[0][x] + dx)
            row, found_row = _find(self.keys[1], column * self.spans[1] + y + dy)
            owner = every[found & found_row]
            base = row[owner] * self.spans[2] + z[owner]
            lowest = 1 if (dx, dy) == (0, 0) else -_REACH
            first = torch.searchsorted(self.keys[2], base + lowest)
            last = torch.searchsorted(self.keys[2], base + _REACH, right=True)
            yield expand_ranges(first, last - first, owner)


def _find(keys: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Return where each wanted key is among the sorted keys, and whether it is there at all."""
    place = torch.searchsorted(keys, wanted).clamp(max=max(len(keys) - 1, 0))
    return place, keys[place] == wanted
