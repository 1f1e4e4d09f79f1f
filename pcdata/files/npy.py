"""The header of a ``.npy`` array, held against the bytes that follow it before anything is allocated.

Read by a pattern, not by Python's parser as NumPy does: that one fails in many ways on nested brackets and signs.

Source: NumPy enhancement proposal 1 (a simple file format for NumPy arrays).
"""

from __future__ import annotations

import io
import math
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError

PREFIX = 12  # bytes that tell the length of the header
MAX_HEADER = 1 << 16  # bytes; plain arrays need 128

_ITEM = (
    r"(?:'descr'\s*:\s*'(?P<descr>[^'\\]{1,32})'"
    r"|'fortran_order'\s*:\s*(?P<order>True|False)"
    r"|'shape'\s*:\s*\((?P<shape>[\d\s,L]{0,2000})\))"
)
_ITEMS = re.compile(rf"\s*{_ITEM}\s*(?:,|(?=\}}))", re.ASCII)
_LARGEST = 1 << 62  # bytes: beyond it, products of sizes overflow in NumPy


def npy_bytes(array: NDArray) -> memoryview:
    """Return the bytes of a ``.npy`` file."""
    packed = io.BytesIO()
    np.save(packed, array, allow_pickle=False)
    return packed.getbuffer()


def write_npy(path: Path, array: NDArray) -> None:
    """Write a ``.npy`` file, through memory: NumPy itself does not say why a disk takes no more.

    Raises:
        OSError: it cannot be written.
    """
    path.write_bytes(npy_bytes(array))


@dataclass(frozen=True)
class NpyHeader:
    """What an array is, and where its bytes begin."""

    shape: tuple[int, ...]
    by_columns: bool
    dtype: np.dtype
    begin: int

    @property
    def nbytes(self) -> int:
        """The size of the array in bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def header_length(start: bytes) -> int:
    """Return how many bytes from the beginning of the file a header takes, from the first :data:`PREFIX`.

    Raises:
        CacheError: no .npy file.
    """
    if start[:6] != b"\x93NUMPY" or len(start) < PREFIX:
        raise CacheError("it does not begin as a .npy array does")
    version = (start[6], start[7])
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise CacheError(f"it has npy version {version[0]}.{version[1]}; 1.0 to 3.0 are known")
    wide = version != (1, 0)
    length: int = 12 + struct.unpack_from("<I", start, 8)[0] if wide else 10 + struct.unpack_from("<H", start, 8)[0]
    if not PREFIX <= length <= MAX_HEADER:
        raise CacheError(f"its header claims {length} bytes; there are {PREFIX} to {MAX_HEADER}")
    return length


def parse_header(header: bytes, size: int) -> NpyHeader:
    """Return what a header says of an array that takes ``size`` bytes with it.

    Raises:
        CacheError: damaged; not plain numbers or texts; or the array would not fill those bytes exactly.
    """
    begin = header_length(header[:PREFIX])
    if len(header) != begin:
        raise CacheError("its header ends early")
    text = header[10 if header[6] == 1 else 12 :].decode("latin-1").strip()
    found = _fields(text)
    dtype = _dtype(found["descr"])
    try:
        shape = tuple(int(part.strip().removesuffix("L")) for part in found["shape"].split(",") if part.strip())
    except ValueError as error:
        raise CacheError(f"its shape cannot be read: ({found['shape']:.100})") from error
    result = NpyHeader(shape, found["order"] == "True", dtype, begin)
    if len(shape) > 32 or math.prod(max(1, length) for length in shape) * dtype.itemsize > _LARGEST:
        raise CacheError(f"it claims shape {shape!s:.200} of {dtype}, which no memory holds")
    if begin + result.nbytes != size:
        raise CacheError(
            f"it claims shape {shape} of {dtype}, which takes {result.nbytes} bytes, but {size - begin} follow its "
            "header; the header is damaged, or the array is cut short"
        )
    return result


def array_in(content: bytearray) -> NDArray:
    """Return the array of a whole .npy file in memory, without a copy.

    Raises:
        CacheError: as for :func:`parse_header`.
    """
    header = parse_header(bytes(content[: header_length(bytes(content[:PREFIX]))]), len(content))
    order: Literal["C", "F"] = "F" if header.by_columns else "C"
    if not header.nbytes:
        return np.zeros(header.shape, header.dtype, order)
    return np.ndarray(header.shape, header.dtype, buffer=content, offset=header.begin, order=order)


def _fields(text: str) -> dict[str, str]:
    if not (text.startswith("{") and text.endswith("}")):
        raise CacheError(f"its header cannot be read: {text!r:.100}")
    fields: dict[str, str] = {}
    place, stop = 1, len(text) - 1
    while place < stop and text[place:stop].strip():
        item = _ITEMS.match(text, place)
        if item is None:
            if re.search(r"'descr'\s*:\s*\[", text):
                raise CacheError("it holds rows with named fields, not plain numbers; store each field as an array")
            raise CacheError(f"its header cannot be read: {text!r:.200}")
        (name, value), *again = [pair for pair in item.groupdict().items() if pair[1] is not None]
        if again or name in fields:
            raise CacheError(f"its header names {name} twice")
        fields[name] = value
        place = item.end()
    if len(fields) != 3:
        raise CacheError(f"its header must tell descr, fortran_order and shape, got {text!r:.200}")
    return fields


def _dtype(text: str) -> np.dtype:
    if text.lstrip("<>|=") in ("O", "O8", "O4"):
        raise CacheError("it holds Python objects, which are never unpickled")
    if not re.fullmatch(r"[<>|=]?(?:[biufcSUV?]\d{1,9}|\?|[mM]8(?:\[[\w/]{1,12}\])?)", text):
        raise CacheError(f"its dtype {text!r:.100} is none of numbers or texts")
    try:
        dtype = np.dtype(text)
    except (TypeError, ValueError) as error:
        raise CacheError(f"its dtype {text!r:.100} is none that this machine has") from error
    if dtype.itemsize == 0:
        raise CacheError(f"its dtype {text!r:.100} has no bytes")
    return dtype
