"""Arrays of a zarr v2 directory, read chunk by chunk; Blosc chunks and filters need the extra ``zarr``."""

from __future__ import annotations

import bz2
import gzip
import io
import itertools
import json
import lzma
import math
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.errors import CacheError
from pcdata.extras import require

# Codecs of the standard library; numcodecs has the others. Each unpacks no more bytes than it is told.
_DECODERS: dict[str, Callable[[bytes, int], bytes]] = {
    "zlib": lambda content, most: zlib.decompressobj().decompress(content, most),
    "gzip": lambda content, most: gzip.GzipFile(fileobj=io.BytesIO(content)).read(most),
    "bz2": lambda content, most: bz2.BZ2Decompressor().decompress(content, most),
    "lzma": lambda content, most: lzma.LZMADecompressor().decompress(content, most),
}
_MAX_CHUNK = 1 << 31  # bytes; Blosc's own limit
_MAX_FILTERED = 8  # a filter may store numbers as wider ones, at most from one byte to eight


def zarr_arrays(folder: str | Path) -> dict[str, ZarrArray]:
    """Return every array under a zarr v2 directory by its path inside it.

    Raises:
        CacheError: no zarr v2 directory, or a header that cannot be read.
    """
    folder = Path(folder)
    if (folder / "zarr.json").exists():
        raise CacheError(f"{folder}: is zarr v3, which loaders that pin zarr 2 cannot open; write it as v2")
    arrays = {
        path.parent.relative_to(folder).as_posix().removeprefix("."): ZarrArray(path.parent)
        for path in sorted(folder.rglob(".zarray"))
    }
    if not arrays:
        raise CacheError(f"{folder}: holds no zarr v2 array (no .zarray); is it the folder of a dataset?")
    return arrays


class ZarrArray:
    """One array: ``array[3]`` reads the chunks of one row, ``array[...]`` all."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            header: dict[str, Any] = json.loads((folder / ".zarray").read_text(encoding="utf-8"))
            self.shape: tuple[int, ...] = tuple(header["shape"])
            self.chunks: tuple[int, ...] = tuple(header["chunks"])
            self.dtype = np.dtype(header["dtype"])
            # In the order of decoding: the compressor was the last to be applied.
            codecs = [header["compressor"], *reversed(header["filters"] or [])]
            self._codecs: list[dict[str, Any]] = [codec for codec in codecs if codec is not None]
            self._order, self._fill = header["order"], header["fill_value"]
            self._separator: str = header.get("dimension_separator", ".")
            if not all(isinstance(codec["id"], str) for codec in self._codecs):
                raise TypeError("a codec without a name")
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise CacheError(f"{folder}: its .zarray cannot be read: {error!r}") from error
        self._last: tuple[tuple[int, ...], np.ndarray] | None = None
        if not all(isinstance(size, int) and size >= 0 for size in (*self.shape, *self.chunks)):
            raise CacheError(f"{folder}: sizes must be whole numbers, got shape {self.shape}, chunks {self.chunks}")
        if len(self.chunks) != len(self.shape) or 0 in self.chunks:
            raise CacheError(f"{folder}: every axis needs chunks of at least 1, got {header}")
        if self._chunk_bytes > _MAX_CHUNK:
            raise CacheError(
                f"{folder}: a chunk {self.chunks} of {self.dtype} has {self._chunk_bytes} bytes, more than {_MAX_CHUNK}"
            )

    @property
    def ndim(self) -> int:
        """The number of axes."""
        return len(self.shape)

    @property
    def nbytes(self) -> int:
        """The size of the whole array in bytes, as its header claims."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def _chunk_bytes(self) -> int:
        return math.prod(self.chunks) * self.dtype.itemsize

    def stored_bytes(self) -> int:
        """Return the size of the chunks on disk."""
        return sum(path.stat().st_size for path in self.folder.rglob("*") if path.is_file())

    def __getitem__(self, index: Any) -> np.ndarray:
        """Read one row of the first axis, or everything for ``...``."""
        if not self.shape:
            return self._scalar()
        if index is Ellipsis:
            return self._read(0, self.shape[0])
        if not 0 <= index < self.shape[0]:
            raise IndexError(index)
        row: np.ndarray = self._read(index, index + 1)[0]
        return row

    def _filled(self, shape: tuple[int, ...]) -> np.ndarray:
        if self.dtype.hasobject:  # only when it is asked for: a store may hold texts beside its numbers
            raise CacheError(f"{self.folder}: must hold numbers, got {self.dtype}")
        try:
            return np.full(shape, 0 if self._fill is None else self._fill, self.dtype)
        except (ValueError, TypeError, OverflowError) as error:
            raise CacheError(f"{self.folder}: its fill value cannot be {self._fill!r:.100}: {error}") from error

    def _scalar(self) -> np.ndarray:
        empty = self._filled(())
        block = self._chunk((0,))  # an array without axes has one chunk, named 0
        return empty if block is None else block

    def _read(self, start: int, stop: int) -> np.ndarray:
        result = self._filled((stop - start, *self.shape[1:]))
        grids = [range(start // self.chunks[0], -(-stop // self.chunks[0]))]
        grids += [range(-(-size // chunk)) for size, chunk in zip(self.shape[1:], self.chunks[1:])]
        for position in itertools.product(*grids):
            block = self._chunk(position)
            if block is None:  # never written: the fill value
                continue
            low = position[0] * self.chunks[0]
            first, last = max(low, start), min(low + self.chunks[0], stop)
            inside = [slice(p * c, min((p + 1) * c, s)) for p, c, s in zip(position, self.chunks, self.shape)][1:]
            taken = tuple(slice(0, part.stop - part.start) for part in inside)
            result[(slice(first - start, last - start), *inside)] = block[(slice(first - low, last - low), *taken)]
        return result

    def _chunk(self, position: tuple[int, ...]) -> np.ndarray | None:
        if self._last is not None and self._last[0] == position:  # rows are asked for one after another
            return self._last[1]
        path = self.folder / self._separator.join(map(str, position))
        if not path.exists():
            return None
        try:
            content = self._decoded(path.read_bytes())
            block = np.frombuffer(content, self.dtype).reshape(self.chunks, order=self._order)
        except (
            OSError, ValueError, TypeError, EOFError, RuntimeError, zlib.error, lzma.LZMAError,
        ) as error:  # fmt: skip
            raise CacheError(f"{path}: this chunk cannot be read: {error}") from error
        self._last = (position, block)
        return block

    def _decoded(self, content: bytes) -> bytes:
        most = _MAX_FILTERED * self._chunk_bytes + 1  # one more than any chunk: too long is an error, not a cut
        for codec in self._codecs:
            if codec["id"] in _DECODERS:
                content = _DECODERS[codec["id"]](content, most)
            else:
                content = bytes(require("numcodecs").get_codec(codec).decode(content))
        return content
