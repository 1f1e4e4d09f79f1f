"""Sizes that a file claims for its arrays, held against the bytes that it has, before anything is allocated."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.errors import CacheError

# Deflate cannot pack tighter than 1032:1, LZF not tighter than 100:1; a larger claim is a bomb or a damaged header.
_MAX_RATIO = 1100


def checked_members(archive: zipfile.ZipFile, path: Path) -> list[zipfile.ZipInfo]:
    """Return a zip file's members if the sizes that it claims can be true."""
    members = archive.infolist()
    size = path.stat().st_size
    if sum(member.compress_size for member in members) > size:
        raise CacheError(f"its members claim more bytes than its {size}")
    if len({member.filename for member in members}) != len(members):
        raise CacheError("two members have one name")
    for member in members:
        if member.file_size > _MAX_RATIO * member.compress_size:
            raise CacheError(f"member {member.filename!r} claims {member.file_size} bytes from {member.compress_size}")
    return members


def read_npy(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Read an array after comparing the size that its header claims with the bytes it has."""
    readers: dict[tuple[int, int], Callable[..., Any]] = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        if version not in readers:
            raise CacheError(f"member {member.filename!r} has npy version {version}")
        try:
            shape, by_columns, dtype = readers[version](stream)
        except MemoryError as error:  # Python's parser on nested signs, not a lack of memory
            raise CacheError(f"member {member.filename!r} has a header that cannot be parsed") from error
        if dtype.hasobject:
            raise CacheError(f"member {member.filename!r} holds Python objects, which are never unpickled")
        expected = int(np.prod(shape, dtype=object)) * dtype.itemsize
        if expected + stream.tell() != member.file_size:
            raise CacheError(f"member {member.filename!r} claims shape {shape} of {dtype} in {member.file_size} bytes")
        content = bytearray(stream.read())  # to the end, where zipfile compares the checksum
    return np.ndarray(shape, dtype, buffer=content, order="F" if by_columns else "C")


def checked_dataset(group: Any, name: str) -> Any:
    """Return an HDF5 dataset, unread, that is stored inside this very file and is no larger than its bytes allow."""
    import h5py

    dataset = group[name] if isinstance(group.get(name, getlink=True), h5py.HardLink) else None
    if not isinstance(dataset, h5py.Dataset) or dataset.external or dataset.is_virtual:
        raise CacheError(f"{group.name}/{name} must be a dataset stored in this file, not a link to another")
    if dataset.shape is None or dataset.dtype.kind not in "biufS":
        raise CacheError(f"{group.name}/{name} must hold numbers or one text, got {dataset.dtype}")
    stored = dataset.id.get_storage_size()
    chunks = [] if dataset.chunks is None else [dataset.chunks]  # unpacked whole, however little of one is used
    for shape in [dataset.shape, *chunks]:
        claimed = int(np.prod(shape, dtype=object)) * dataset.dtype.itemsize
        if claimed > (stored if dataset.compression is None else _MAX_RATIO * stored):
            raise CacheError(f"{group.name}/{name} claims shape {shape} of {dataset.dtype} but stores {stored} bytes")
    return dataset
