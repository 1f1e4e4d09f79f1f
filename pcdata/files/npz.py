"""``.npz`` archives: named arrays, readable and written so that ``numpy.load`` and ours agree."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from typing import IO

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.files.npy import PREFIX, NpyHeader, array_in, header_length, parse_header
from pcdata.files.zip_archive import Member, ZipArchive

_SUFFIX = ".npy"


def array_names(archive: ZipArchive) -> dict[str, Member]:
    """Return the arrays of an archive by name: those of members without their ending.

    Raises:
        CacheError: two members mean one array.
    """
    named = {name.removesuffix(_SUFFIX): member for name, member in archive.members.items()}
    if len(named) != len(archive.members):
        raise CacheError("two members have one name, apart from the ending .npy")
    return named


def read_array(archive: ZipArchive, member: Member) -> NDArray:
    """Read one array.

    Raises:
        CacheError: damaged, or of Python objects, which are never unpickled.
    """
    try:
        return array_in(archive.read(member))
    except CacheError as error:
        if str(error).startswith("member"):
            raise
        raise CacheError(f"member {member.name!r:.100}: {error}") from error


def npy_header(archive: ZipArchive, member: Member) -> NpyHeader:
    """Return what the header of a member that is stored as it is says.

    Raises:
        CacheError: as for :func:`read_array`.
    """
    try:
        length = header_length(archive.start_of(member, PREFIX))
        return parse_header(archive.start_of(member, length), member.size)
    except CacheError as error:
        raise CacheError(f"member {member.name!r:.100}: {error}") from error


def write_npz(file: IO[bytes], arrays: Mapping[str, NDArray], *, compressed: bool = False) -> None:
    """Write what ``numpy.savez`` and ``numpy.savez_compressed`` write.

    Those take ``allow_pickle=False`` from NumPy 2.1 on; before, they store it as an array, which cannot be read back.
    """
    method = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, array in arrays.items():
            # force_zip64: the size is not known when the member begins.
            with archive.open(f"{name}{_SUFFIX}", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
