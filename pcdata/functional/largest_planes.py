"""The plane of each cloud that most points lie on, for clouds in arrays with room for more."""

from __future__ import annotations

import functools

import numpy as np
import torch
from numpy.random import RandomState
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.contracts.on_host import uploaded
from pcdata.functional.planes import draw_rows, ransac_plane
from pcdata.rng import seeded

MOST_POINTS = 1 << 28  # of a cloud whose rows torch draws by 32 bits
_TRIED = (3, 1000, 123_457, MOST_POINTS - 1)  # sizes of clouds for which the words are held to torch's draws


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


@functools.lru_cache(maxsize=8)
def words_drawn(seed: int, count: int, device: torch.device) -> Tensor | None:
    """Return (3, count) words of 32 bits: modulo the number of rows left they are what draw_rows draws of any cloud.

    Torch's generator is the Mersenne Twister that NumPy has too (Matsumoto & Nishimura, ACM TOMACS 8(1), 1998). None
    where this version of torch draws otherwise.
    """
    state = RandomState(seeded(seed).initial_seed() & 0xFFFFFFFF)
    words = state.randint(0, 1 << 32, size=(3, count), dtype=np.uint32).astype(np.int64)
    for size in _TRIED:
        first, second, third = (row % (size - taken) for taken, row in enumerate(words))
        second += second >= first
        low, high = np.minimum(first, second), np.maximum(first, second)
        third += third >= low
        third += third >= high
        expected = draw_rows(size, 3, count, seeded(seed)).numpy()
        if not np.array_equal(np.stack([first, second, third], axis=1), expected):
            return None
    return uploaded(torch.from_numpy(words), device)
