"""A tree of boxes over points in Morton order, as ``core/pc/gpu/box_tree.hpp`` walks it."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.kernels.cuda.launching import Launcher

_FAN = 32  # points to a leaf, nodes to a parent


class BoxTree(NamedTuple):
    """Points in their order, and boxes over them, the leaves first."""

    points: Tensor  # (N, 3), as they were given
    ptr: Tensor  # (B+1,)
    box: Tensor  # (2, 3): the box of all points, by which they were sorted
    order: Tensor  # (N,) int64: the rows in order
    placed: Tensor  # (N, 4) float32: x, y, z and the bits of the row
    sides: Tensor  # (6, M) float32: low and high sides of the boxes
    least_rows: Tensor  # (M,) int32: the lowest row in each

    @property
    def nodes(self) -> int:
        """How many boxes there are on all levels."""
        return len(self.least_rows)


def box_tree(launcher: Launcher, points: Tensor, ptr: Tensor) -> BoxTree:
    """Sort points and put boxes over them; nothing here waits for the device."""
    rows, device = len(points), points.device
    box = torch.stack(points.aminmax(dim=0)) if rows else points.new_zeros((2, 3))
    order = in_order(launcher, points, ptr, box)
    placed = torch.empty((rows, 4), dtype=torch.float32, device=device)
    launcher.launch("pc_place_in_order", rows, points, order, rows, placed)
    return BoxTree(points, ptr, box, order, placed, *boxes_over(launcher, placed))


def boxes_over(launcher: Launcher, placed: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sides of boxes over points in their order, and the lowest row in each."""
    rows, device = len(placed), placed.device
    levels = [-(-rows // _FAN)]
    while levels[-1] > _FAN:
        levels.append(-(-levels[-1] // _FAN))
    nodes = sum(levels)
    sides = torch.empty((6, nodes), dtype=torch.float32, device=device)
    least_rows = torch.empty(nodes, dtype=torch.int32, device=device)
    launcher.launch("pc_box_leaves", levels[0], placed, rows, levels[0], sides, least_rows, nodes)
    below = 0
    for lower, level in pairwise(levels):
        first = below + lower
        launcher.launch("pc_box_parents", level, first, level, below, sides, least_rows, nodes)
        below = first
    return sides, least_rows


def in_order(launcher: Launcher, points: Tensor, ptr: Tensor, box: Tensor) -> Tensor:
    """Return (N,) int64 rows sorted by cloud and along a curve that fills a box; equal points keep their order."""
    rows, clouds = len(points), len(ptr) - 1
    bits = min(21, (63 - max(0, clouds - 1).bit_length()) // 3)
    keys = torch.empty(rows, dtype=torch.int64, device=points.device)
    launcher.launch("pc_morton_keys", rows, points, ptr, clouds, rows, box, bits, keys)
    return keys.argsort(stable=True)
