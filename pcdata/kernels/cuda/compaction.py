"""Rows that are kept, moved together within arrays of the same size."""

from __future__ import annotations

import torch
from torch import Tensor

import pcdata.functional.fixed_rows  # noqa: F401 - the function must be registered before its kernel
from pcdata.contracts.dispatch import kernel
from pcdata.kernels.cuda.launching import launcher_of


@kernel("move_kept", "cuda", roomy=True)
def move_kept(points: Tensor, source_index: Tensor, ptr: Tensor, keep: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Count the marks, then move every row once."""
    rows, clouds = len(points), len(ptr) - 1
    kept_points, kept_source, kept_ptr = map(torch.empty_like, (points, source_index, ptr))
    launcher_of(points).launch(
        "pc_move_kept",
        *(max(rows, clouds + 1), points, source_index, keep, keep.cumsum(0, dtype=torch.int32)),
        *(ptr, clouds, rows, kept_points, kept_source, kept_ptr),
    )
    return kept_points, kept_source, kept_ptr
