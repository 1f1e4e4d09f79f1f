"""What is asked of every depth image of a stream before anything else."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner


@dataclass(frozen=True)
class DepthLook:
    """What one look at depth tells."""

    least: float  # NaN where a value is NaN or infinite, and the largest too
    largest: float
    is_same: bool  # as those before, value for value; False where there are none


@inner
def look_at_depth(depth: Tensor, before: Tensor | None = None, copy: Tensor | None = None) -> DepthLook:
    """Look at depth (V, H, W) float32, compare it with that before, and write it to ``copy``, both of its shape."""
    values = depth.detach()
    least, largest = torch.stack(values.aminmax()).tolist()  # NaN where there is one
    if not (math.isfinite(least) and math.isfinite(largest)):
        least = largest = math.nan
    is_same = before is not None and torch.equal(values, before)
    if copy is not None:
        copy.copy_(values)
    return DepthLook(least, largest, is_same)
