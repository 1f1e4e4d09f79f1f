"""The plane of each cloud that most points lie on, for clouds in arrays with room for more."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.functional.planes import ransac_plane


@inner
def largest_planes(
    points: Tensor,  # (C, 3)
    ptr: Tensor,  # (B+1,); ptr[B] <= C
    distance: float,
    num_hypotheses: int,
    seed: int,
    probability: float | None,
) -> tuple[Tensor, Tensor, Tensor]:  # planes (B, 4) float64, near (C,) bool, failed (1,) int32
    """Run :func:`ransac_plane`; ``failed`` is not 0 where that would refuse a cloud, or needs to look at it again."""
    count = int(ptr[-1])
    planes, near = ransac_plane(
        points[:count],
        ptr,
        distance=distance,
        num_hypotheses=num_hypotheses,
        seed=seed,
        probability=probability,
        backend="torch",
    )
    near = torch.cat([near, near.new_zeros(len(points) - count)])
    return planes, near, torch.zeros(1, dtype=torch.int32, device=points.device)
