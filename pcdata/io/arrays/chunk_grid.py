"""Arrays stored as a grid of chunks, read row by row: what zarr directories and packed HDF5 datasets share."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError


class ChunkGrid:
    """One array: ``array[3]`` reads the chunks of one row, ``array[...]`` all. Formats say how a chunk is read."""

    def __init__(self, where: str, shape: tuple[int, ...], chunks: tuple[int, ...], dtype: np.dtype) -> None:
        self.where, self.shape, self.chunks, self.dtype = where, shape, chunks, dtype
        # Rows are asked for one after another, so the chunks of the last one are kept.
        self._band: dict[tuple[int, ...], NDArray[Any]] = {}
        if len(chunks) != len(shape) or any(size < 1 for size in chunks) or any(size < 0 for size in shape):
            raise CacheError(f"{where}: every axis needs a chunk of at least 1, got shape {shape}, chunks {chunks}")

    @property
    def ndim(self) -> int:
        """The number of axes."""
        return len(self.shape)

    @property
    def nbytes(self) -> int:
        """The size of the whole array in bytes, as its header claims."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def chunk_bytes(self) -> int:
        """The size of one unpacked chunk in bytes."""
        return math.prod(self.chunks) * self.dtype.itemsize

    @property
    def num_chunks(self) -> int:
        """How many chunks the whole array has."""
        return math.prod(-(-size // chunk) for size, chunk in zip(self.shape, self.chunks))

    def chunk(self, position: tuple[int, ...]) -> NDArray[Any]:
        """Read the chunk at a position of the grid, in its full size.

        Raises:
            CacheError: it is missing or damaged.
        """
        raise NotImplementedError

    def __getitem__(self, index: Any) -> NDArray[Any]:
        """Read one row of the first axis, or everything for ``...``."""
        if index is Ellipsis and self.shape == self.chunks:
            return np.array(self.chunk((0,) * len(self.shape)))
        if index is Ellipsis:
            return self._read(0, self.shape[0])
        if not 0 <= index < self.shape[0]:
            raise IndexError(index)
        row: NDArray[Any] = self._read(index, index + 1)[0]
        return row

    def _read(self, start: int, stop: int) -> NDArray[Any]:
        result = np.empty((stop - start, *self.shape[1:]), self.dtype)
        grids = [range(start // self.chunks[0], -(-stop // self.chunks[0]))]
        grids += [range(-(-size // chunk)) for size, chunk in zip(self.shape[1:], self.chunks[1:])]
        for position in itertools.product(*grids):
            block = self._kept(position)
            low = position[0] * self.chunks[0]
            first, last = max(low, start), min(low + self.chunks[0], stop)
            inside = [slice(p * c, min((p + 1) * c, s)) for p, c, s in zip(position, self.chunks, self.shape)][1:]
            taken = tuple(slice(0, part.stop - part.start) for part in inside)
            result[(slice(first - start, last - start), *inside)] = block[(slice(first - low, last - low), *taken)]
        return result

    def _kept(self, position: tuple[int, ...]) -> NDArray[Any]:
        if self._band and next(iter(self._band))[0] != position[0]:
            self._band.clear()
        if position not in self._band:
            self._band[position] = self.chunk(position)
        return self._band[position]
