"""Points inside grippers, looked for in a grid over the points."""

from __future__ import annotations

import torch
from torch import Tensor

import pcdata.functional.grasps  # noqa: F401 - the function must be registered before its kernel
from pcdata.contracts.dispatch import kernel
from pcdata.kernels.cpu.native import call, room


@kernel("points_in_grippers", "cpu")
def points_in_grippers(
    points: Tensor, axes: Tensor, origin: Tensor, lower: Tensor, upper: Tensor
) -> tuple[Tensor, Tensor]:
    """Ask of every gripper the cells of the grid that it reaches into."""
    hits, held = room(len(axes), torch.int64), room(len(axes), torch.int64)
    grippers = (one.contiguous() for one in (axes, origin, lower, upper))
    call("pc_points_in_grippers", points.contiguous(), len(points), *grippers, len(axes), hits, held)
    return hits, held
