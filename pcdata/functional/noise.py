"""Random numbers for the rows of clouds, drawn from a seed per cloud: the same bits on every device and in any batch.

Row by row they are words of the cloud's stream (:func:`pcdata.rng.words`), turned into numbers by sums, products and
square roots alone, which every processor rounds in the same way; no library's logarithm or sine.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts, transform_points
from pcdata.functional.stored_rows import gather_kept
from pcdata.rng import words

# Of log(1 + f) / f for f in [sqrt(1/2) - 1, sqrt(2) - 1], and of sine and cosine in the square of quarter turns within
# [-1/2, 1/2]: least squares at Chebyshev nodes, as float32, the lowest power first. noise.hpp has the same.
LOGARITHM = (1, -0.49999988, 0.33334184, -0.25002155, 0.19956978, -0.16560696, 0.14949095, -0.1437733, 0.087439455)
SINE = (1.5707964, -0.6459635, 0.07968022, -0.004602163)
COSINE = (1, -1.2337005, 0.2536692, -0.02086007, 0.0009036299)
LOG_2 = 0.693147182464599609375  # as float32


def standard_normal(word: Tensor) -> Tensor:
    """Return (..., 2) float32 standard normal numbers for (...) int64 words, by Box and Muller; up to 5.9 in size.

    The upper half of a word gives the radius, 24 bits of it; the lower half the angle.
    """
    upper, lower = (word >> 32) & 0xFFFFFFFF, word & 0xFFFFFFFF
    unit = ((upper >> 8).to(torch.float32) + 0.5) * 2.0**-24
    bits = unit.view(torch.int32)
    exponent = (bits - 0x3F3504F3) >> 23
    f = (bits - (exponent << 23)).view(torch.float32) - 1.0
    log = _polynomial(LOGARITHM, f) * f + exponent.to(torch.float32) * LOG_2
    # By float64, rounded once: the root of float32 that torch takes from MKL is now and then one bit off.
    radius = (log * -2.0).clamp(min=0.0).double().sqrt().float()
    quadrant = lower >> 30
    angle = (((lower & 0x3FFFFFFF) >> 6).to(torch.float32) + 0.5) * 2.0**-24 - 0.5
    square = angle * angle
    sine, cosine = _polynomial(SINE, square) * angle, _polynomial(COSINE, square)
    is_odd = (quadrant & 1) == 1
    one, other = torch.where(is_odd, sine, cosine), torch.where(is_odd, cosine, sine)
    one = torch.where(((quadrant + 1) & 2) == 2, -one, one)
    other = torch.where((quadrant & 2) == 2, -other, other)
    return torch.stack([radius * one, radius * other], dim=-1)


def _polynomial(coefficients: Sequence[float], x: Tensor) -> Tensor:
    value = torch.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * x + coefficient
    return value


def normal_rows(ptr: Tensor, seeds: Tensor) -> Tensor:
    """Return (N, 3) float32 standard normal numbers, drawn from each cloud's seed.

    Every 64 rows of a cloud have 96 words of it, 32 of each axis in turn: the first number of a word is that of one of
    the first 32 rows, the second that of one of the others. So processors draw them side by side.
    """
    cloud = cloud_of_rows(ptr)
    row = torch.arange(len(cloud), dtype=torch.int64, device=ptr.device) - ptr[cloud]
    axis = torch.arange(3, dtype=torch.int64, device=ptr.device)
    number = (row // 64 * 96 + row % 32)[:, None] + 32 * axis
    pairs = standard_normal(words(seeds.to(ptr.device)[cloud][:, None], number))
    return torch.where((row % 64 < 32)[:, None], pairs[..., 0], pairs[..., 1])


# What happens to points one after another: a motion by (B, 4, 4), or noise: its seeds (B,), its standard deviation, and
# the largest change.
PointStep = Tensor | tuple[Tensor, float, float | None]


@inner
def move_points(
    points: Tensor,
    ptr: Tensor,
    steps: Sequence[PointStep],
    kept: tuple[Tensor, Tensor] | None = None,
    *,
    in_place: bool = False,
    sources: Tensor | None = None,
) -> Tensor:
    """Move (N, 3) float32 points by some steps, rounded to float32 after each; ``in_place`` in their own memory.

    ``kept`` says which are returned: a (N,) bool mask, and the (B+1,) row pointers of those. ``sources`` (B,) int64 are
    the addresses of each cloud's points, in memory that somebody holds; then ``points`` is room for the result alone.
    """
    if sources is not None:
        in_place, points = True, gather_kept({"points": points}, {"points": sources}, ptr)["points"]
    before = points
    for step in steps:
        if isinstance(step, Tensor):
            points = transform_points(points, ptr, step.to(points.device))
        else:
            seeds, sigma, clip = step
            noise = normal_rows(ptr, seeds) * sigma
            points = points + (noise if clip is None else noise.clamp(-clip, clip))
    if kept is not None:
        points = points[kept[0]]
        before = before[: len(points)]
    return before.copy_(points) if in_place else points


def random_rows(counts: Tensor, wanted: Tensor, seeds: Tensor) -> Tensor:
    """Return a (N,) bool mask with ``wanted`` (B,) rows of each cloud, every choice as likely as any other; on the CPU.

    Halves of the words of a seed name rows; the first so many different ones are chosen, or, of more than half of the
    rows, left out.
    """
    masks = []
    for count, number, seed in zip(counts.tolist(), wanted.tolist(), seeds, strict=True):
        few = min(number, count - number)
        rows = _first_different(count, few, seed)
        mask = np.full(count, number > few)
        mask[rows] = number == few
        masks.append(mask)
    return torch.from_numpy(np.concatenate([np.zeros(0, bool), *masks]))


@inner
def random_order(
    counts: Tensor,  # (B,) int64 rows of each cloud, on the CPU
    wanted: Tensor,  # (B,) int64, at most those, on the CPU
    seeds: Tensor,  # (B,) int64, on the CPU
) -> Tensor:  # (M,) int64 rows of all clouds
    """Return the first ``wanted`` rows of a random permutation of each cloud's: more of them extend fewer.

    Rows are sorted by the upper half of their word of the cloud's seed; where two are equal, the lower row comes first.
    """
    ptr = ptr_from_counts(counts)
    cloud = cloud_of_rows(ptr)
    row = torch.arange(len(cloud), dtype=torch.int64, device="cpu") - ptr[cloud]
    key = (words(seeds[cloud], row) >> 32) & 0xFFFFFFFF
    order = (cloud << 32 | key).argsort(stable=True)
    return order[row < wanted[cloud]]  # rows of the sorted lie in their own cloud's places


def random_with_repeats(counts: Tensor, wanted: Tensor, seeds: Tensor) -> Tensor:
    """Return (M,) int64 rows of all clouds, ``wanted`` (B,) of each cloud's ``counts``, each drawn anew; on the CPU."""
    ptr = ptr_from_counts(wanted)
    cloud = cloud_of_rows(ptr)
    number = torch.arange(len(cloud), dtype=torch.int64, device="cpu") - ptr[cloud]
    drawn = words(seeds[cloud], number) >> 1 & (2**62 - 1)
    return ptr_from_counts(counts)[cloud] + drawn % counts[cloud].clamp(min=1)


@inner
def dropped_rows(
    keys: Tensor,  # (B,) int64, of streams that begin with word 0, on the CPU
    ptr: Tensor,  # (B+1,) int64, on the CPU
    low: float,
    high: float,
) -> tuple[Tensor, Tensor]:
    """Return a (N,) bool mask of what stays of each cloud without a part of it in [low, high), and its row pointers.

    The first word of a stream gives the part, the second the seed of the rows that stay; of any rows, one at least.
    """
    counts = ptr[1:] - ptr[:-1]
    drawn = words(keys[:, None], torch.arange(2, dtype=torch.int64, device="cpu"))
    part = low + (high - low) * (((drawn[:, 0] >> 11) & ((1 << 53) - 1)).double() * 2.0**-53)
    kept = torch.maximum(counts - (counts * part).round().long(), counts.clamp(max=1))
    return random_rows(counts, kept, (drawn[:, 1] >> 2) & ((1 << 62) - 1)), ptr_from_counts(kept)


def _first_different(count: int, few: int, seed: Tensor) -> np.ndarray:
    drawn = 2 * few + 64
    while few:
        word = words(seed, torch.arange(drawn, dtype=torch.int64, device="cpu"))
        halves = torch.stack([word & 0xFFFFFFFF, (word >> 32) & 0xFFFFFFFF], dim=1).reshape(-1)
        rows = ((halves * count) >> 32).numpy()
        _, first = np.unique(rows, return_index=True)
        if len(first) >= few:
            return rows[np.sort(first)[:few]]
        drawn *= 2
    return np.zeros(0, np.int64)
