"""Random rows of a cloud, and the words that they are made of whatever its size."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import torch
from numpy.random import RandomState
from torch import Tensor

from pcdata.contracts.on_host import uploaded
from pcdata.rng import seeded

MOST_POINTS = 1 << 28  # of a cloud whose rows torch draws by 32 bits
_TRIED = (3, 1000, 123_457, MOST_POINTS - 1)  # sizes of clouds for which the words are held to torch's draws
_KEPT = 8  # sets of words


def draw_rows(num_points: int, size: int, count: int, generator: torch.Generator) -> Tensor:
    """Draw (count, size) rows of a cloud, distinct within each draw and uniform: each skips over those before it."""
    drawn: list[Tensor] = []
    rising: list[Tensor] = []  # the same in order
    for row in _numbers_of_rows(num_points, size, count, generator):
        for before in rising:
            row += row >= before
        drawn.append(row)
        for place, other in enumerate(rising):
            rising[place], row = torch.minimum(other, row), torch.maximum(other, row)
        rising.append(row)
    return torch.stack(drawn, dim=1)


def _numbers_of_rows(num_points: int, size: int, count: int, generator: torch.Generator) -> list[Tensor]:
    """Draw ``size`` rows (count,) each, counted among those that none before took."""
    return [torch.randint(num_points - taken, (count,), generator=generator, device="cpu") for taken in range(size)]


@functools.lru_cache(maxsize=_KEPT)
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


@functools.lru_cache(maxsize=_KEPT)
def _words_of_any(count: int, seeds: tuple[int, ...]) -> tuple[Tensor, Tensor] | None:
    """Return what serves clouds of any size; None where seeds are many, or torch draws otherwise."""
    number: dict[int, int] = {}
    which = [number.setdefault(seed, len(number)) for seed in seeds]
    if len(number) > _KEPT:
        return None
    kept = [words for seed in number if (words := words_drawn(seed, count, torch.device("cpu"))) is not None]
    if len(kept) < len(number):
        return None
    return torch.stack(kept), torch.from_numpy(np.array(which, np.int64))


def words_of_clouds(counts: Sequence[int], count: int, seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return words (T, 3, count) of draws on the CPU, as of :func:`words_drawn`, and which each cloud takes, (B,).

    Args:
        counts: points of each cloud, three or more.
        count: of draws.
        seeds: one for each cloud.
    """
    shared = _words_of_any(count, tuple(seeds)) if max(counts) < MOST_POINTS else None
    if shared is not None:
        return shared
    draws: dict[tuple[int, int], int] = {}
    which = [draws.setdefault(draw, len(draws)) for draw in zip(counts, seeds)]
    words = torch.stack([torch.stack(_numbers_of_rows(size, 3, count, seeded(seed))) for size, seed in draws])
    return words, torch.from_numpy(np.array(which, np.int64))
