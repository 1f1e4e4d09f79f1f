"""Sort a few images pixel by pixel: a network of minima and maxima, much faster than a sort along a short axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache

import torch
from torch import Tensor


def sort_images(images: Sequence[Tensor]) -> list[Tensor]:
    """Return as many new images, the k-th of which holds at every pixel the k-th smallest of the given values.

    The given images, of one shape and dtype, stay as they are.

    Source: Batcher, Sorting networks and their applications, 1968 (odd-even merge sort).
    """
    ordered = list(images)
    for low, high in network(len(ordered)):
        below = torch.minimum(ordered[low], ordered[high])
        ordered[high] = torch.maximum(ordered[low], ordered[high])
        ordered[low] = below
    return ordered


def pick_image(images: Sequence[Tensor], which: Tensor) -> Tensor:
    """Return at every pixel the value of image ``which`` (an integer image) there."""
    picked = images[0].clone()
    for rank, image in enumerate(images[1:], start=1):
        torch.where(which == rank, image, picked, out=picked)
    return picked


@cache
def network(count: int) -> tuple[tuple[int, int], ...]:
    """Return the pairs (low, high) to compare and exchange, in order, that sort ``count`` values."""
    return tuple(_odd_even_merge_sort(count))


def _odd_even_merge_sort(count: int) -> Iterator[tuple[int, int]]:
    width = 1
    while width < count:
        step = width
        while step >= 1:
            for start in range(step % width, count - step, 2 * step):
                for low in range(start, min(start + step, count - step)):
                    if low // (2 * width) == (low + step) // (2 * width):
                        yield low, low + step
            step //= 2
        width *= 2
