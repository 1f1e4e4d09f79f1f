"""Clouds in arrays of fixed sizes, for a device that repeats the same work on every frame without asking the host.

Arrays have room for every pixel of the images that the clouds come from. How many rows a cloud has is a number on the
device, so a step that drops rows changes no size, and the host waits for nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner


@dataclass(frozen=True)
class FixedRows:
    """Clouds with room for more rows than they have; what lies behind the last row is finite and means nothing."""

    points: Tensor  # (C, 3) float32
    source_index: Tensor  # (C,) int64
    ptr: Tensor  # (B+1,) int64; ptr[B] <= C
    viewpoint: Tensor  # (B, 3) where each cloud's sensor stood
    chosen: Tensor  # (C,) bool or int64 rows: which rows of those before the step these are
    normals: Tensor | None = None  # (C, 3)
    told: Tensor | None = None  # (B, K) float64: what the host is to be told beside the number of rows
    counts: tuple[int, ...] | None = None  # rows of each cloud, where the host knows them: then there is no more room


@inner
def move_kept(
    points: Tensor,  # (C, 3)
    source_index: Tensor,  # (C,) int64
    ptr: Tensor,  # (B+1,)
    keep: Tensor,  # (C,) bool; behind the last row it may be anything
) -> tuple[Tensor, Tensor, Tensor]:  # likewise points, source_index and ptr
    """Move the rows to be kept together, in their order; what lies behind them becomes 0."""
    room = len(points)
    place = torch.arange(room, dtype=torch.int64, device=points.device)
    keep = keep & (place < ptr[-1])
    ends = keep.cumsum(0)
    target = torch.where(keep, ends - 1, room)

    def moved(values: Tensor) -> Tensor:
        kept = values.new_zeros((room + 1, *values.shape[1:]))
        kept[target] = values
        return kept[:room]

    return moved(points), moved(source_index), torch.cat([ends.new_zeros(1), ends])[ptr]
