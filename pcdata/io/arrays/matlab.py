"""Numeric arrays of MATLAB's MAT files, versions 4 and 5 (which versions 6 and 7 of MATLAB write).

SciPy's reader is compiled code that trusts the file: nested cells and cut tags end the process. Only matrices of real
numbers are read here; everything else is stepped over by the size that its tag states, never opened.

Source: MathWorks, MAT-File Format, R2024b: chapter 1 (level 5) and chapter 2 (level 4).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError

_MATRIX, _COMPRESSED = 14, 15
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_OTHER = {1: "a cell array", 2: "a struct", 3: "an object", 4: "text", 5: "a sparse matrix"}
_LEVEL_4 = {0: "f8", 10: "f4", 20: "i4", 30: "i2", 40: "u2", 50: "u1"}
_COMPLEX = 0x0800
_MOST_AXES = 32  # NumPy's limit before 2.0
_HEAD = 4096  # bytes of a packed matrix that hold its flags, sizes and name (MATLAB's names have 63 characters)


def numeric_arrays(where: str, data: bytes, names: Collection[str], *, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Return the named arrays that a MAT file holds, in native byte order; names it does not hold are left out.

    Args:
        where: the file, for messages.
        data: the whole file.
        names: which variables to read.
        max_bytes: what all of them may take together once unpacked.

    Raises:
        CaptureError: no MAT file of version 4 or 5, damaged, one of them is no matrix of real numbers, or too large.
    """
    try:
        found = dict[str, NDArray[Any]]()
        for name, array in _level_5(data, names, max_bytes) if _is_level_5(data) else _level_4(data, names, max_bytes):
            if name in found:
                raise _Damaged(f"{name} is there twice")
            found[name] = array
            max_bytes -= array.nbytes
        return found
    except (_Damaged, struct.error, zlib.error, ValueError, OverflowError) as error:
        raise CaptureError(
            f"{where}: not a readable MATLAB 5 file: {error}; save it again (MATLAB: save -v7; SciPy: savemat)"
        ) from error


class _Damaged(Exception):
    """What is wrong with the file."""


@dataclass(frozen=True)
class _Element:
    kind: int
    content: memoryview
    end: int  # where the next one starts


def _is_level_5(data: bytes) -> bool:
    if data[:8] == b"\x89HDF\r\n\x1a\n" or data[:10] == b"MATLAB 7.3":
        raise _Damaged("it is version 7.3, which is HDF5")
    return len(data) >= 128 and data[126:128] in (b"IM", b"MI") and 0 not in data[:4]  # level 4 starts with a number


def _level_5(data: bytes, names: Collection[str], max_bytes: int) -> Any:
    order = "<" if data[126:128] == b"IM" else ">"
    if (version := struct.unpack_from(order + "H", data, 124)[0]) != 0x0100:
        raise _Damaged(f"it states version {version:#x}")
    rest, start = memoryview(data), 128
    while start < len(rest):
        element = _element(rest, start, order, padded=False)
        start = element.end
        body = element.content
        if element.kind == _COMPRESSED:
            body = _unpacked(body, order, names, max_bytes)
        elif element.kind != _MATRIX:
            raise _Damaged(f"an element of type {element.kind} stands where a variable should")
        name, array = _matrix(body, order, names, max_bytes)
        if array is not None:
            yield name, array


def _element(data: memoryview, start: int, order: str, *, padded: bool = True) -> _Element:
    """Return the element that starts at a byte; sizes are held against the bytes that are there."""
    if start + 8 > len(data):
        raise _Damaged("it is cut short")
    kind, size = struct.unpack_from(order + "II", data, start)
    if kind >> 16:  # up to four bytes stand in the tag itself
        kind, size, first, end = kind & 0xFFFF, kind >> 16, start + 4, start + 8
        if size > 4:
            raise _Damaged(f"a short element claims {size} bytes")
    else:
        first = start + 8
        end = first + (-(-size // 8) * 8 if padded else size)
    if first + size > len(data):
        raise _Damaged(f"an element claims {size} bytes where {len(data) - first} follow")
    return _Element(kind, data[first : first + size], min(end, len(data)))


def _unpacked(packed: memoryview, order: str, names: Collection[str], max_bytes: int) -> memoryview:
    """Unpack a variable, no further than its head unless it is wanted; return the content of its matrix element."""
    stream = zlib.decompressobj()
    head = stream.decompress(packed, _HEAD)
    if len(head) < 8:
        raise _Damaged("a packed variable is cut short")
    kind, size = struct.unpack_from(order + "II", head)
    if kind != _MATRIX:
        raise _Damaged(f"an element of type {kind} stands where a variable should")
    if size + 8 > len(head):
        if _head(memoryview(head)[8:], order).name not in names:
            return memoryview(head)[8:]
        if size > max_bytes + _HEAD:
            raise _Damaged(f"a variable unpacks to {size} bytes, the limit is {max_bytes}")
        head += stream.decompress(stream.unconsumed_tail, size + 9 - len(head))
    else:
        head += stream.decompress(stream.unconsumed_tail, 1)  # nothing more, but zlib compares its checksum
    if not stream.eof or len(head) != size + 8:
        raise _Damaged(f"a variable claims {size} bytes but unpacks to {'more or ' * (not stream.eof)}{len(head) - 8}")
    return memoryview(head)[8:]


@dataclass(frozen=True)
class _Head:
    flags: int
    shape: tuple[int, ...]
    name: str
    end: int


def _head(body: memoryview, order: str) -> _Head:
    flags = _element(body, 0, order)
    shape = _element(body, flags.end, order)
    name = _element(body, shape.end, order)
    known = flags.kind == 6 and shape.kind == 5 and name.kind in (1, 2)
    if not known or len(flags.content) != 8 or len(shape.content) % 4:
        raise _Damaged("a variable has no flags, sizes and name where they should be")
    axes = len(shape.content) // 4
    if not 2 <= axes <= _MOST_AXES:
        raise _Damaged(f"a variable has {axes} axes")
    word = struct.unpack_from(order + "I", flags.content)[0]
    return _Head(word, struct.unpack(f"{order}{axes}i", shape.content), bytes(name.content).decode("latin-1"), name.end)


def _matrix(body: memoryview, order: str, names: Collection[str], max_bytes: int) -> tuple[str, NDArray[Any] | None]:
    if not len(body):  # what MATLAB writes for an empty variable without a name
        return "", None
    head = _head(body, order)
    if head.name not in names:
        return head.name, None
    kind = head.flags & 0xFF
    if kind not in _CLASSES or head.flags & _COMPLEX:
        what = "complex" if kind in _CLASSES else _OTHER.get(kind, f"of class {kind}")
        raise _Damaged(f"{head.name} must be a matrix of real numbers, but is {what}")
    stored = _element(body, head.end, order)
    if stored.kind not in _STORED:
        raise _Damaged(f"{head.name} is stored as type {stored.kind}, which is no number")
    if stored.end != len(body):
        raise _Damaged(f"{len(body) - stored.end} bytes follow the numbers of {head.name}")
    array = _shaped(head.name, stored.content, order + _STORED[stored.kind], head.shape)
    wanted = np.dtype(_CLASSES[kind])
    if array.size * wanted.itemsize > max_bytes:
        raise _Damaged(f"{head.name} takes {array.size * wanted.itemsize} bytes, the limit is {max_bytes}")
    with np.errstate(all="ignore"):
        values = array.astype(wanted)
        same = np.array_equal(values.astype(array.dtype), array, equal_nan=wanted.kind == array.dtype.kind == "f")
    if not same:
        raise _Damaged(f"{head.name} is stored as numbers that {wanted} cannot hold")
    return head.name, values


def _shaped(name: str, content: memoryview, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    count = 1
    for length in shape:
        count *= length
    if min(shape) < 0 or count * np.dtype(dtype).itemsize != len(content):
        raise _Damaged(f"{name} claims the shape {shape} but stores {len(content)} bytes")
    return np.frombuffer(content, dtype).reshape(shape, order="F")


def _level_4(data: bytes, names: Collection[str], max_bytes: int) -> Any:
    rest, start = memoryview(data), 0
    while start < len(rest):
        if start + 20 > len(rest):
            raise _Damaged("it is cut short")
        order = "<" if struct.unpack_from("<I", rest, start)[0] < 10_000 else ">"
        kind, rows, columns, imaginary, length = struct.unpack_from(order + "5i", rest, start)
        machine, precision, content = kind // 1000, kind % 1000 - kind % 10, kind % 10
        if machine not in (0, 1) or (machine == 1) != (order == ">") or precision not in _LEVEL_4 or content > 2:
            raise _Damaged(f"it starts with {bytes(rest[start : start + 4])!r}, as no MAT file does")
        if min(rows, columns) < 0 or imaginary not in (0, 1) or not 0 < length <= _HEAD:
            raise _Damaged("a variable has sizes that cannot be")
        dtype = np.dtype(order + _LEVEL_4[precision])
        first = start + 20 + length
        size = rows * columns * dtype.itemsize
        start = first + size * (1 + imaginary)
        if start > len(rest):
            raise _Damaged(f"a variable claims {size} bytes where {max(0, len(rest) - first)} follow")
        name = bytes(rest[first - length : first]).rstrip(b"\0").decode("latin-1")
        if name in names:
            if content or imaginary:
                raise _Damaged(f"{name} must be a matrix of real numbers")
            if size > max_bytes:
                raise _Damaged(f"{name} takes {size} bytes, the limit is {max_bytes}")
            array = _shaped(name, rest[first : first + size], dtype.str, (rows, columns))
            yield name, array.astype(dtype.newbyteorder("="))
