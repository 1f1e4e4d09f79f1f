"""Arrays of a zarr v2 directory, read chunk by chunk; Blosc chunks and filters need the extra ``zarr``."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError, MissingExtraError
from pcdata.files.library_errors import WRITE_AGAIN, told_by_library
from pcdata.files.opening import check_inside, open_input, read_text
from pcdata.files.packing import check_packing
from pcdata.files.strict_json import parse_json
from pcdata.io.arrays.chunk_grid import ChunkGrid
from pcdata.io.arrays.zarr_codecs import Decoder, decoder_of

_MAX_CHUNK = 1 << 31  # bytes; Blosc's own limit
_MAX_HEADER = 1 << 16  # bytes
_MAX_FOLDERS = 100_000  # that are searched for arrays
_MAX_DEPTH = 16


def zarr_array(folder: Path, name: str) -> _ZarrArray | None:
    """Return the array at a path inside a zarr v2 directory; None if there is none.

    Raises:
        CacheError: zarr v3, or a header that cannot be read or be true.
    """
    place = folder.joinpath(*(part for part in name.split("/") if part not in ("", ".", "..")))
    return _ZarrArray(place, folder) if os.path.lexists(place / ".zarray") else None


def zarr_names(folder: Path, most: int) -> list[str]:
    """Return the paths of the arrays inside a zarr v2 directory, but no more than ``most``; links are not followed.

    Raises:
        CacheError: zarr v3, or no array.
    """
    if (folder / "zarr.json").exists():
        raise CacheError(f"{folder}: is zarr v3, which loaders that pin zarr 2 cannot open; write it as v2")
    names = sorted(islice(_names_below(folder), most))
    if not names:
        raise CacheError(
            f"{folder}: holds no zarr v2 array (no .zarray); give the folder or file with the arrays of a "
            "data set. Captures are judged by 'pcdata validate'"
        )
    return names


def _names_below(folder: Path) -> Iterator[str]:
    for number, (place, folders, files) in enumerate(os.walk(folder)):
        inside = Path(place).relative_to(folder)
        if ".zarray" in files:
            folders.clear()  # below are chunks
            yield inside.as_posix().removeprefix(".")
        if len(inside.parts) >= _MAX_DEPTH:
            folders.clear()
        folders.sort()
        if number > _MAX_FOLDERS:
            return


class _ZarrArray(ChunkGrid):
    """One array: ``array[3]`` reads the chunks of one row, ``array[...]`` all.

    Every chunk must be there: zarr reads a missing one as the fill value, so that a wrong byte in the header, or a copy
    that stopped early, becomes a cloud of zeros.
    """

    def __init__(self, folder: Path, root: Path) -> None:
        self.folder, self._root = folder, root
        _check_inside(folder / ".zarray", root)
        text = read_text("zarr", folder / ".zarray", max_bytes=_MAX_HEADER, error=CacheError)
        try:
            header: dict[str, Any] = parse_json(text)
            shape, chunks = tuple(header["shape"]), tuple(header["chunks"])
            if not all(type(size) is int and 0 <= size < 1 << 62 for size in (*shape, *chunks)) or len(shape) > 32:
                raise ValueError(f"sizes must be whole numbers, got shape {shape}, chunks {chunks}")
            dtype = _dtype(header["dtype"])
            # An array without axes has one chunk, named 0.
            super().__init__(str(folder), shape or (1,), chunks or (1,), dtype)
            self._scalar = not shape
            self._order = _one_of(header, "order", ("C", "F"))
            self._separator = _one_of(header, "dimension_separator", (".", "/"), ".")
            _one_of(header, "zarr_format", (2,))
            self._codecs = header["compressor"], header["filters"]
            self._decode: Decoder | None = None
        except CacheError:
            raise
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise CacheError(
                f"{folder}: its .zarray cannot be read: {told_by_library(error)}; {WRITE_AGAIN}"
            ) from error
        if self.chunk_bytes > _MAX_CHUNK:
            raise CacheError(
                f"{folder}: a chunk {self.chunks} of {dtype} has {self.chunk_bytes} bytes, more than {_MAX_CHUNK}"
            )
        if self._scalar:
            self.shape = ()

    def checked(self) -> _ZarrArray:
        """Return this array once its codecs are known and its chunks are there, no more and no fewer.

        Raises:
            CacheError: they are not; or the array claims more than they can hold.
        """
        try:
            self._decode = decoder_of(*self._codecs)
        except CacheError as error:
            raise CacheError(f"{self.folder}: {error}") from error
        found, stored = 0, 0
        for place in self._chunk_files():
            found += 1
            stored += place.stat(follow_symlinks=True).st_size
            if found > self.num_chunks:
                break
        if found != self.num_chunks:
            self._explain(found)
        check_packing(f"{self.folder}:", self.nbytes, stored)
        return self

    def chunk(self, position: tuple[int, ...]) -> NDArray[Any]:
        """Read and unpack one chunk."""
        decode = self._decode or self.checked()._decode
        assert decode is not None
        path = self.folder / self._separator.join(map(str, position))
        _check_inside(path, self._root)
        with open_input("zarr", path, max_bytes=2 * _MAX_CHUNK, error=CacheError) as file:
            stored = os.fstat(file.fileno()).st_size
            check_packing(f"{path}: this chunk", self.chunk_bytes, stored)
            content = file.read(stored)
        try:
            content = decode(content, self.chunk_bytes)
            return np.frombuffer(content, self.dtype).reshape(self.chunks, order=self._order)
        except MissingExtraError:
            raise
        except Exception as error:  # numcodecs raises many types on damaged bytes
            raise CacheError(f"{path}: this chunk cannot be read: {error}") from error

    def __getitem__(self, index: Any) -> NDArray[Any]:
        """Read one row of the first axis, or everything for ``...``."""
        return self.chunk((0,))[0] if self._scalar else super().__getitem__(index)

    @property
    def num_chunks(self) -> int:
        """How many chunks the whole array has."""
        return 1 if self._scalar else super().num_chunks

    def _chunk_files(self) -> Iterator[os.DirEntry[str]]:
        """Yield the entries that are chunks by their names, whatever they lie in."""
        nested = self._separator == "/" and len(self.shape) > 1
        waiting = [(self.folder, 1)]
        while waiting:
            folder, depth = waiting.pop()
            with os.scandir(folder) as entries:
                for entry in entries:
                    if not entry.name[:1].isdecimal():
                        if not entry.name.startswith("."):
                            raise CacheError(f"{folder / entry.name}: is no chunk of the array; move it out")
                    elif nested and depth < len(self.shape):
                        if not entry.is_dir(follow_symlinks=False):
                            raise CacheError(
                                f"{folder / entry.name}: is no folder, though chunks lie in folders "
                                f"(dimension_separator is '/'); .zarray is damaged, or the file is not its"
                            )
                        waiting.append((folder / entry.name, depth + 1))
                    else:
                        yield entry

    def _explain(self, found: int) -> None:
        """Raise the error that names a chunk that is missing, or one too many."""
        axes = [-(-size // chunk) for size, chunk in zip(self.shape, self.chunks)]
        pattern = r"\.".join([r"(\d+)"] * max(1, len(axes) if self._separator == "." else 1))
        for entry in islice(self._chunk_files(), self.num_chunks + 1):
            named = re.fullmatch(pattern, entry.name)
            if named is None or (
                self._separator == "." and not all(int(n) < most for n, most in zip(named.groups(), axes or [1]))
            ):
                raise CacheError(
                    f"{Path(entry.path)}: is no chunk of an array {self.shape} in chunks {self.chunks}; .zarray is "
                    "damaged, or the file is not its: copy the array again, or move the file out"
                )
        first = next(
            (name for name in self._names() if not os.path.lexists(self.folder / name)), "the last of its chunks"
        )
        raise CacheError(
            f"{self.folder}: claims {self.num_chunks} chunks, for shape {self.shape} in chunks {self.chunks}, but has "
            f"{found}; missing is {first}, which would be read as its fill value. Copy the array again; if its writer "
            "left out chunks that hold nothing else, write it again with write_empty_chunks=True"
        )

    def _names(self) -> Iterator[str]:
        axes = [-(-size // chunk) for size, chunk in zip(self.shape, self.chunks)]
        for number in range(min(self.num_chunks, 1_000_000)):
            position = np.unravel_index(number, axes or [1])
            yield self._separator.join(map(str, position))


def _check_inside(path: Path, root: Path) -> None:
    try:
        check_inside("zarr", path, [root], CacheError)
    except CacheError as error:
        raise CacheError(f"{path}: leads out of {root}; copy the file itself there if it belongs to it") from error


def _one_of(header: dict[str, Any], key: str, known: tuple[Any, ...], default: Any = None) -> Any:
    value = header.get(key, default)
    if type(value) is not type(known[0]) or value not in known:
        raise ValueError(f"{key} must be {' or '.join(map(repr, known))}, got {value!r:.100}")
    return value


def _dtype(text: Any) -> np.dtype:
    if isinstance(text, list):  # rows with named fields: refused as such when they are asked for
        return np.dtype("V1")
    if not isinstance(text, str) or not re.fullmatch(r"[<>|=]?[a-zA-Z]\d{0,9}(?:\[\w{1,12}\])?", text):
        raise ValueError(f"a dtype {text!r:.100}")
    return np.dtype(text)
