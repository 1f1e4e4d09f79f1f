"""HDF5 datasets, taken for no more than they can be: no links elsewhere, no unknown filters, no size beyond the bytes.

Deflated chunks are unpacked here and not by HDF5, whose filter goes on for as long as the stream does, whatever the
chunk's size is. LZF stays with HDF5: it cannot pack tighter than 88 to 1.

Source: HDF5 File Format Specification 3.0, IV.A.2.l (filter pipeline); H5checksum.c (Fletcher32).
"""

from __future__ import annotations

import errno
import math
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.files.packing import check_packing
from pcdata.io.arrays.chunk_grid import ChunkGrid

_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF = 1, 2, 3, 32000
_KNOWN = {_DEFLATE: "gzip", _SHUFFLE: "shuffle", _FLETCHER32: "fletcher32", _LZF: "lzf"}
_OTHERS = {4: "szip", 5: "nbit", 6: "scaleoffset", 32001: "blosc", 32004: "lz4", 32008: "bitshuffle", 32015: "zstd"}
_MAX_ARRAYS = 4096  # in one group

# What the operating system says when another process holds a lock; anything else means that there are no locks.
_IN_USE = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES)


def open_hdf5(path: Path, mode: str = "r") -> Any:
    """Open a file.

    Raises:
        CacheError: it is locked by another process, or its file system has no locks: the file itself may be fine.
        OSError: what else h5py raises.
    """
    import h5py

    try:
        return h5py.File(path, mode)
    except OSError as error:
        if not re.search(r"\block", str(error)):  # not that of "superblock", where the file is cut short
            raise
        told = re.search(r"errno = (\d+)", str(error))
        number = int(told[1]) if told else error.errno
        if number in _IN_USE:
            raise CacheError(
                f"{path}: is in use: another process has it open{' for writing' if mode == 'r' else ''} and holds its "
                "lock; wait until that process has ended, or end it, and try again; the file itself may be fine"
            ) from error
        raise CacheError(
            f"{path}: cannot be locked here: its file system has no locks ({error}); the file itself may be fine. If "
            "nobody writes to it, set HDF5_USE_FILE_LOCKING=FALSE in the environment before Python starts, or copy it "
            "to a local disk"
        ) from error


def hard_linked(group: Any, name: str) -> Any:
    """Return the group or dataset under a path of names, none of which is a link; None if there is none."""
    import h5py

    found = group
    for part in name.split("/"):
        if not part or part == "." or not isinstance(found, h5py.Group):
            return None
        if not isinstance(found.get(part, getlink=True, default=None), h5py.HardLink):
            return None
        found = found[part]
    return found


def read_group(group: Any, file_bytes: int) -> dict[str, NDArray[Any]]:
    """Read all datasets of a group.

    Raises:
        CacheError: one of them is no dataset in this file, or together they claim more than their bytes allow.
    """
    if len(group) > _MAX_ARRAYS:
        raise CacheError(f"{group.name} has {len(group)} datasets, more than {_MAX_ARRAYS}")
    datasets = {name: checked_dataset(group, name, file_bytes) for name in group}
    stored = sum(dataset.stored_bytes for dataset in datasets.values())
    if stored > file_bytes:
        raise CacheError(f"{group.name} stores {stored} bytes, but the file has {file_bytes}")
    check_packing(group.name, sum(dataset.nbytes for dataset in datasets.values()), stored)
    return {name: dataset[...] for name, dataset in datasets.items()}


def checked_dataset(group: Any, name: str, file_bytes: int) -> _Hdf5Array | _Hdf5Deflated:
    """Return a dataset, unread, that lies in this very file and is no larger than its bytes allow.

    Raises:
        CacheError: it is none.
    """
    from h5py import h5d, h5o, h5s

    where = f"{group.name.rstrip('/')}/{name}"
    folder, _, last = name.rpartition("/")
    parent = hard_linked(group, folder) if folder else group
    # h5py's own objects ask for all of this several times over: a sample of ten arrays took twice as long to read.
    found: Any = h5o.open(parent.id, last.encode()) if parent is not None and _is_hard(parent, last) else None
    plan = found.get_create_plist() if isinstance(found, h5d.DatasetID) else None
    if plan is None or plan.get_layout() == h5d.VIRTUAL or plan.get_external_count():
        raise CacheError(f"{where} must be a dataset stored in this file, not a link to another")
    space, dtype = found.get_space(), found.dtype
    if space.get_simple_extent_type() == h5s.NULL or dtype.kind not in "biufS" or not dtype.itemsize:
        raise CacheError(f"{where} must hold numbers or one text, got {dtype}")
    shape: tuple[int, ...] = space.shape
    chunks: Any = plan.get_chunk() if plan.get_layout() == h5d.CHUNKED else None
    filters = _filters_of(where, plan, dtype.itemsize, math.prod(chunks or ()) * dtype.itemsize)
    stored, claimed = found.get_storage_size(), math.prod(shape) * dtype.itemsize
    packed = bool(filters.keys() & {_DEFLATE, _LZF})
    if stored > file_bytes or (claimed > stored and not packed):
        raise CacheError(
            f"{where} claims shape {shape} of {dtype}, but stores {stored} bytes in a file of {file_bytes}"
        )
    if chunks is not None:
        # Chunks are unpacked whole, however little of one is used.
        check_packing(f"{where} claims shape {shape}; a chunk", math.prod(chunks) * dtype.itemsize, stored)
        grid = math.prod(-(-size // chunk) for size, chunk in zip(shape, chunks))
        if (there := found.get_num_chunks()) != grid:
            raise CacheError(
                f"{where} claims shape {shape} in chunks {chunks}, but has {there} of {grid} chunks; the others would "
                "be read as zeros; write the whole array"
            )
    check_packing(where, claimed, stored)
    if _DEFLATE in filters:
        return _Hdf5Deflated(where, found, shape, chunks, dtype, filters, stored)
    return _Hdf5Array(found, shape, dtype, stored)


def _is_hard(group: Any, name: str) -> bool:
    from h5py import h5l

    try:
        return bool(group.id.links.get_info(name.encode()).type == h5l.TYPE_HARD)
    except KeyError:
        return False


class _Hdf5Array:
    """A dataset that HDF5 reads: not packed, or by LZF."""

    def __init__(self, dataset: Any, shape: tuple[int, ...], dtype: np.dtype, stored_bytes: int) -> None:
        self._dataset, self.shape, self.dtype, self.stored_bytes = dataset, shape, dtype, stored_bytes
        self.nbytes = math.prod(shape) * dtype.itemsize

    def __getitem__(self, index: Any) -> NDArray[Any]:
        """Read a row, or everything for ``...``."""
        import h5py

        if index is not Ellipsis:
            return np.asarray(h5py.Dataset(self._dataset)[index])
        result = np.zeros(self.shape, self.dtype)
        if result.size:
            self._dataset.read(h5py.h5s.ALL, h5py.h5s.ALL, result)
        return result


class _Hdf5Deflated(ChunkGrid):
    """A dataset of deflated chunks, each unpacked to exactly its size."""

    def __init__(
        self,
        where: str,
        dataset: Any,
        shape: tuple[int, ...],
        chunks: tuple[int, ...],
        dtype: np.dtype,
        filters: Mapping[int, tuple[int, ...]],
        stored_bytes: int,
    ) -> None:
        import h5py

        super().__init__(where, shape, chunks, dtype)
        self._dataset, self._filters, self.stored_bytes = dataset, filters, stored_bytes
        if dtype.kind == "S" or dataset.get_type() != h5py.h5t.py_create(dtype, logical=True):
            raise CacheError(f"{where} stores {dtype} in a form that no machine has; write it again")

    def chunk(self, position: tuple[int, ...]) -> NDArray[Any]:
        """Read and unpack one chunk."""
        skipped, content = self._dataset.read_direct_chunk(
            tuple(place * size for place, size in zip(position, self.chunks))
        )
        content = bytes(content)
        for number, code in reversed(list(enumerate(self._filters))):
            if not skipped >> number & 1:  # a chunk that would have grown is stored as it is
                content = _UNDO[code](content, self.chunk_bytes, self.dtype.itemsize)
        if len(content) != self.chunk_bytes:
            raise CacheError(f"{self.where}: a chunk has {len(content)} bytes, not {self.chunk_bytes}")
        return np.frombuffer(content, self.dtype).reshape(self.chunks)


def _filters_of(where: str, plan: Any, itemsize: int, chunk_bytes: int) -> dict[int, tuple[int, ...]]:
    """Return the filters of a dataset in the order of packing, with their numbers."""
    found: dict[int, tuple[int, ...]] = {}
    for number in range(plan.get_nfilters()):
        code, _, values, _ = plan.get_filter(number)
        if code not in _KNOWN:
            raise CacheError(
                f"{where} is packed by the HDF5 filter {_OTHERS.get(code, code)}; only {', '.join(_KNOWN.values())} "
                "are read; write it again with one of them, as in h5repack -f GZIP=4 IN OUT"
            )
        if code in found:
            raise CacheError(f"{where} is packed twice by the filter {_KNOWN[code]}: a few bytes would fill the memory")
        found[code] = tuple(values)
    if {_DEFLATE, _LZF} <= found.keys():
        raise CacheError(f"{where} is packed twice, by gzip and lzf: a few bytes would fill the memory")
    if (_SHUFFLE in found and found[_SHUFFLE][:1] != (itemsize,)) or (
        _LZF in found and found[_LZF][2:3] != (chunk_bytes,)
    ):
        raise CacheError(f"{where} has filters for values or chunks of another size")
    return found


def _inflated(content: bytes, most: int, itemsize: int) -> bytes:
    unpack = zlib.decompressobj()
    try:
        result = unpack.decompress(content, most + 8)  # 8 more than a chunk: too long is an error, and a checksum fits
    except zlib.error as error:
        raise CacheError(f"a chunk is damaged: {error}") from error
    if not unpack.eof or unpack.unused_data:
        raise CacheError(f"a chunk is damaged: it does not end with the {most} bytes that it stands for")
    return result


def _unshuffled(content: bytes, most: int, itemsize: int) -> bytes:
    count = len(content) // itemsize
    planes = np.frombuffer(content, np.uint8, count * itemsize).reshape(itemsize, count)
    return planes.T.tobytes() + content[count * itemsize :]


def _fletcher_checked(content: bytes, most: int, itemsize: int) -> bytes:
    if len(content) < 4:
        raise CacheError("a chunk is damaged: its checksum is missing")
    data, stored = content[:-4], int.from_bytes(content[-4:], "little")
    right = fletcher32(data)
    # Files of HDF5 before 1.6.3 have the bytes of each half the other way round.
    swapped = (right & 0x00FF00FF) << 8 | (right & 0xFF00FF00) >> 8
    if stored not in (right, swapped):
        raise CacheError("a chunk is damaged: its checksum is wrong")
    return data


def fletcher32(data: bytes) -> int:
    """Return HDF5's checksum: sums of big-endian 16-bit words and of these sums, modulo 65535 with 65535 for 0."""
    words = np.frombuffer(data + b"\0" * (len(data) % 2), ">u2")
    first = second = 0
    for start in range(0, len(words), 1 << 20):
        part = words[start : start + (1 << 20)].astype(np.uint64)
        # The sum after word i counts word j once for every j <= i.
        second += first * len(part) + int((part * np.arange(len(part), 0, -1, dtype=np.uint64)).sum())
        first += int(part.sum())
    low, high = (total % 65535 or (65535 if total else 0) for total in (first, second))
    return high << 16 | low


_UNDO = {_DEFLATE: _inflated, _SHUFFLE: _unshuffled, _FLETCHER32: _fletcher_checked}
