"""Numbers that tell which rows were chosen: equal for equal choices, on every device and by every kernel.

A mask has one bit per row, the first one lowest, in words of 64 bits; anything else has the words of its bytes; zeros
fill up the last word. Each word is mixed as word i of the stream whose key it is (:func:`pcdata.rng.words`), these are
added up, and the sum is mixed with the number of rows. That takes one look at the mask, and its parts may be taken in
any order. The upper 32 bits are the number.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pcdata.rng import mixed_words

_WORD = 8  # bytes


def checksums(values: Tensor, bounds: Sequence[int], first: Sequence[int] | None = None) -> list[int]:
    """Return a checksum of the rows of every segment ``bounds[b]:bounds[b + 1]``.

    Args:
        values: (N, ...), on any device.
        bounds: row pointers.
        first: values are row numbers: they count from these, and what is below 0 stays.
    """
    rows = values.detach().cpu().contiguous().numpy()
    if first is not None and any(first[: len(bounds) - 1]):
        begin = np.repeat(np.asarray(first[: len(bounds) - 1]), np.diff(bounds))
        rows = np.where(rows < 0, rows, rows - begin)
    parts = [_words_of(rows[start:stop]) for start, stop in pairwise(bounds)]
    if len(parts) == 1:  # mostly; without the bookkeeping of several
        total = np.add.reduce(mixed_words(parts[0], np.arange(len(parts[0]))), keepdims=True)
        return _upper(total, np.array([bounds[1] - bounds[0]]))
    ends = np.cumsum([0, *map(len, parts)])
    place = np.arange(ends[-1]) - np.repeat(ends[:-1], np.diff(ends))
    before = np.zeros(ends[-1] + 1, np.uint64)
    np.cumsum(mixed_words(np.concatenate(parts), place), out=before[1:])
    return _upper(before[ends[1:]] - before[ends[:-1]], np.diff(bounds))


def _upper(totals: NDArray[np.uint64], counts: NDArray[np.int64]) -> list[int]:
    """Return the numbers of sums of mixed words over so many rows."""
    found: list[int] = (mixed_words(totals, counts) >> np.uint64(32)).tolist()
    return found


def _words_of(rows: NDArray[Any]) -> NDArray[np.uint64]:
    if rows.dtype.itemsize == _WORD and rows.flags.aligned:
        return rows.reshape(-1).view(np.uint64)
    flat = np.packbits(rows, axis=None, bitorder="little") if rows.dtype == bool else rows.reshape(-1).view(np.uint8)
    if not len(flat) % _WORD and not flat.ctypes.data % _WORD:
        return flat.view(np.uint64)
    words = np.zeros(-(-len(flat) // _WORD), np.uint64)
    words.view(np.uint8)[: len(flat)] = flat
    return words
