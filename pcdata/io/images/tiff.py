"""TIFF: what the structure of a file tells of its own wholeness, and floating point that Pillow does not read.

Source: TIFF 6.0, sections 2, 8, 14, 15, 19; Adobe, TIFF technical note 3 (the predictor of floating point).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.io.images.file_wholeness import StructureError, check_inflated

_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
_UNPACKED_PER_BYTE = 1100  # deflate: 1032 to 1; LZW and PackBits pack less tightly
_TYPES = {1: "B", 3: "H", 4: "I"}
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_PLAIN, _DEFLATE = 1, (8, 32946)
_WIDTH, _HEIGHT, _BITS, _PREDICTOR, _TILE_WIDTH, _SAMPLE_FORMAT = 256, 257, 258, 317, 322, 339
_TAGS = {_WIDTH, _HEIGHT, _BITS, 259, 273, 274, 277, 278, 279, 284, _PREDICTOR, _TILE_WIDTH, 323, 324, 325, 330}
_TAGS |= {_SAMPLE_FORMAT}
_WHOLE, _REAL = 1, 3  # sample formats
_READ = ((_WHOLE, 16), (_REAL, 32), (_REAL, 64))  # of one channel


def check_tiff(data: bytes, max_pixels: int) -> None:
    """Check that a TIFF holds one picture whose strips or tiles lie in the file and hold what its size asks for.

    Raises:
        StructureError: cut short, several pictures, or strips of other sizes.
    """
    entries = _only_directory(data)
    width, height = _tiff_one(entries, _WIDTH), _tiff_one(entries, _HEIGHT)
    if not 0 < width * height <= max_pixels:
        raise StructureError(f"an image must have 1 .. {max_pixels} pixels, this one claims {width}x{height}")
    samples, bits = _tiff_one(entries, 277, 1), entries.get(258, (1,))
    if not 1 <= samples <= 4 or len(set(bits)) != 1 or bits[0] not in (1, 4, 8, 16, 32, 64):
        raise StructureError(f"it claims {samples} samples of {bits!s:.60} bits")
    kind = entries.get(_SAMPLE_FORMAT, (_WHOLE,))[0]
    if samples == 1 and bits[0] >= 16 and (kind, bits[0]) not in _READ:
        name = {_WHOLE: "uint", 2: "int", _REAL: "float"}.get(kind, "numbers of an unknown type, ")
        raise StructureError(f"it holds {name}{bits[0]}; save depth as uint16, float32 or float64")
    packing = _tiff_one(entries, 259, 1)
    bits_per_pixel = bits[0] * (samples if _tiff_one(entries, 284, 1) == 1 else 1)
    planes = 1 if _tiff_one(entries, 284, 1) == 1 else samples
    sizes = _tiff_parts(entries, width, height, bits_per_pixel) * planes
    offsets = entries.get(273, entries.get(324, ()))
    counts = entries.get(279, entries.get(325, ()))
    if not len(offsets) == len(counts) == len(sizes):
        raise StructureError(f"it needs {len(sizes)} strips or tiles, but lists {len(offsets)} of {len(counts)} sizes")
    for offset, count, size in zip(offsets, counts, sizes, strict=True):
        if not count or offset + count > len(data) or offset < 8:
            raise StructureError(f"a strip of {count} bytes at byte {offset} lies outside its {len(data)} bytes")
        if packing == _PLAIN and count != size:
            raise StructureError(f"a strip has {count} bytes where the image size asks for {size}")
        if packing in _DEFLATE:
            check_inflated(data[offset : offset + count], size)
        if size > _UNPACKED_PER_BYTE * count:
            raise StructureError(f"a strip of {count} bytes cannot hold the {size} that the image size asks for")


def tiff_size(data: bytes) -> tuple[int, int]:
    """Return (height, width) as the only directory says it.

    Raises:
        StructureError: there is no such directory.
    """
    entries = _only_directory(data)
    return _tiff_one(entries, _HEIGHT), _tiff_one(entries, _WIDTH)


def read_reals(data: bytes, decode: Callable[[bytes], NDArray[Any]]) -> NDArray[Any] | None:  # (H, W) float32, float64
    """Return the pixels of a checked TIFF that Pillow does not read, or not rightly; None = it does.

    It opens no float64, and swaps the bytes of packed big-endian float32 once more after libtiff has.

    Args:
        data: the file.
        decode: makes (H, W) uint8 of a file of bytes; it is given this picture as one with as many bytes a pixel, so
            that it unpacks the strips or tiles without knowing what they mean.

    Raises:
        StructureError: it is turned, or predicted in a way that only whole rows can be put together from.
    """
    entries, order = _only_directory(data), _ORDERS[data[:4]]
    bits, kind = entries.get(_BITS, (1,))[0], entries.get(_SAMPLE_FORMAT, (_WHOLE,))[0]
    if kind != _REAL or (bits, order) == (32, "<"):
        return None
    size, predictor = bits // 8, _tiff_one(entries, _PREDICTOR, 1)
    if _tiff_one(entries, 277, 1) != 1 or _tiff_one(entries, 274, 1) != 1:
        raise StructureError("it has several channels or is turned; save depth as one channel, upright")
    if predictor not in (1, 2, 3) or (predictor != 1 and _TILE_WIDTH in entries):
        raise StructureError(
            f"float{bits} in tiles with predictor {predictor} is not read; save it without a predictor"
        )
    changed = {_WIDTH: size * _tiff_one(entries, _WIDTH), _BITS: 8, _SAMPLE_FORMAT: _WHOLE, _PREDICTOR: 1}
    changed |= {_TILE_WIDTH: size * _tiff_one(entries, _TILE_WIDTH)} if _TILE_WIDTH in entries else {}
    rows = np.ascontiguousarray(decode(_with_entries(data, order, changed)))  # (H, size W) bytes
    if predictor == 3:  # differences of bytes, the most significant of all pixels first
        planes = np.cumsum(rows, axis=1, dtype=np.uint8).reshape(len(rows), size, -1)
        return np.ascontiguousarray(planes.transpose(0, 2, 1)).view(f">f{size}")[..., 0].astype(f"f{size}")
    if predictor == 2:
        steps = rows.view(f"{order}u{size}").astype(f"u{size}")
        return np.cumsum(steps, axis=1, dtype=f"u{size}").view(f"f{size}")
    return rows.view(f"{order}f{size}").astype(f"f{size}")


def _with_entries(data: bytes, order: str, changed: dict[int, int]) -> bytes:
    """Return the file with other whole numbers in entries that it has."""
    found = bytearray(data)
    start = struct.unpack_from(order + "I", data, 4)[0]
    for place in range(start + 2, start + 2 + 12 * struct.unpack_from(order + "H", data, start)[0], 12):
        tag = struct.unpack_from(order + "H", data, place)[0]
        if tag in changed:
            kind, code = (4, "I") if tag in (_WIDTH, _TILE_WIDTH) else (3, "H2x")
            struct.pack_into(order + "HHI" + code, found, place, tag, kind, 1, changed[tag])
    return bytes(found)


def _only_directory(data: bytes) -> dict[int, tuple[int, ...]]:
    if data[:4] in (b"II+\0", b"MM\0+"):
        raise StructureError("it is a BigTIFF, which is not read; save it as a TIFF")
    if data[:4] not in _ORDERS or len(data) < 8:
        raise StructureError("it does not start as a TIFF does")
    order = _ORDERS[data[:4]]
    entries, following = _tiff_directory(data, order, struct.unpack_from(order + "I", data, 4)[0])
    if following:
        raise StructureError("must hold one image, but holds several; save one file each")
    if 330 in entries:
        raise StructureError("must hold one image, but holds others inside it; save one file each")
    return entries


def _tiff_directory(data: bytes, order: str, start: int) -> tuple[dict[int, tuple[int, ...]], int]:
    """Return the whole-number entries of a directory that are read here, and where the next one is."""
    if start + 2 > len(data) or start + 6 + 12 * (count := struct.unpack_from(order + "H", data, start)[0]) > len(data):
        raise StructureError("it is cut short: its directory lies outside the file")
    entries: dict[int, tuple[int, ...]] = {}
    seen, apart = set[int](), 0
    for place in range(start + 2, start + 2 + 12 * count, 12):
        tag, kind, number = struct.unpack_from(order + "HHI", data, place)
        if tag in seen:
            raise StructureError(f"its entry {tag} is there twice")
        seen.add(tag)
        size = number * _SIZES.get(kind, 1)
        at = place + 8 if size <= 4 else struct.unpack_from(order + "I", data, place + 8)[0]
        apart += size if size > 4 else 0
        if at + size > len(data) or apart > len(data):  # entries that share bytes would be read once each
            raise StructureError(f"its entry {tag} lies outside the file")
        if tag in _TAGS and kind in _TYPES:
            entries[tag] = struct.unpack_from(f"{order}{number}{_TYPES[kind]}", data, at)
    return entries, struct.unpack_from(order + "I", data, start + 2 + 12 * count)[0]


def _tiff_one(entries: dict[int, tuple[int, ...]], tag: int, default: int | None = None) -> int:
    values = entries.get(tag, () if default is None else (default,))
    if len(values) != 1:
        raise StructureError(f"its entry {tag} must be one number, but it has {len(values)}")
    return values[0]


def _tiff_parts(entries: dict[int, tuple[int, ...]], width: int, height: int, bits: int) -> list[int]:
    """Return how many bytes each strip or tile of one plane unpacks to."""
    if 322 in entries or 324 in entries:
        across, down = _tiff_one(entries, 322), _tiff_one(entries, 323)
        if not 0 < across <= 1 << 16 or not 0 < down <= 1 << 16:
            raise StructureError(f"its tiles claim {across}x{down} pixels")
        return [(across * bits + 7) // 8 * down] * (-(-width // across) * -(-height // down))
    rows = min(_tiff_one(entries, 278, height), height)
    if rows < 1:
        raise StructureError("its strips claim no row")
    row = (width * bits + 7) // 8
    return [row * min(rows, height - first) for first in range(0, height, rows)]
