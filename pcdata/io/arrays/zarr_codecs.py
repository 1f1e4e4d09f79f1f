"""How zarr v2 chunks are unpacked: codecs by name, each told beforehand how much may come out.

numcodecs knows more codecs than these. One of them, ``pickle``, runs whatever code a chunk holds (before 0.15.2), and
most unpack without a bound. So a codec is chosen from this list, its settings are held against what they may be, and
the size that a chunk claims against what the array needs, before numcodecs sees either.

Source: Zarr storage specification version 2; RFC 8878 (Zstandard); c-blosc, README_CHUNK_FORMAT.rst.
"""

from __future__ import annotations

import bz2
import lzma
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from pcdata.errors import CacheError
from pcdata.extras import require

Decoder = Callable[[bytes, int], bytes]  # a chunk's bytes and the most that may come out of them

_MAX_WIDER = 8  # a filter may store numbers as wider or narrower ones, from one byte to eight
_CHECKSUM = 64  # bytes that checksums may add
_LZMA_MEMORY = 1 << 28  # bytes: the largest dictionary of xz -9 takes 64 MiB


def decoder_of(compressor: Any, filters: Any) -> Decoder:
    """Return what unpacks a chunk into exactly so many bytes, for the codecs that a header names.

    Raises:
        CacheError: a codec that is not on the list, or with settings that it cannot have.
        MissingExtraError: one that numcodecs unpacks, which is not installed.
    """
    if filters is not None and not isinstance(filters, list):
        raise CacheError(f"its filters must be a list, got {type(filters).__name__}")
    given: list[Any] = filters or []
    if len(given) > 8:
        raise CacheError(f"its {len(given)} filters are too many")
    # In the order of decoding: the compressor was the last to be applied.
    steps = [] if compressor is None else [_step(compressor, COMPRESSORS, "compressor")]
    steps += [_step(config, FILTERS, "filter") for config in reversed(given)]

    def decode(content: bytes, size: int) -> bytes:
        most = size if not filters else _MAX_WIDER * size + _CHECKSUM
        for step in steps:
            content = step(content, most)
            if len(content) > most:
                raise CacheError(f"unpacks to {len(content)} bytes or more, but {size} are its size")
        if len(content) != size:
            raise CacheError(f"has {len(content)} bytes, but {size} are its size")
        return content

    return decode


def _step(config: Any, known: Mapping[str, Callable[[dict[str, Any]], Decoder]], kind: str) -> Decoder:
    name = config.get("id") if isinstance(config, dict) else None
    if not isinstance(name, str) or name not in known:
        raise CacheError(
            f"its {kind} {str(name)[:100]!r} is none that arrays of numbers need; it was not run. Known are "
            f"{', '.join(known)}; write the array again with one of them"
        )
    return known[name](config)


# -- compressors of the standard library -----------------------------------------------------------------------------


def _whole(unpack: Any, content: bytes, most: int) -> bytes:
    """Unpack one stream that ends with the content; one byte more than allowed tells that there is more."""
    result: bytes = unpack.decompress(content, most + 1)
    if len(result) <= most and (not unpack.eof or unpack.unused_data):
        raise CacheError("ends early, or has bytes after its end")
    return result


def _zlib(config: dict[str, Any]) -> Decoder:
    return lambda content, most: _whole(zlib.decompressobj(), content, most)


def _gzip(config: dict[str, Any]) -> Decoder:
    return lambda content, most: _whole(zlib.decompressobj(wbits=zlib.MAX_WBITS | 16), content, most)


def _bz2(config: dict[str, Any]) -> Decoder:
    return lambda content, most: _whole(bz2.BZ2Decompressor(), content, most)


def _lzma(config: dict[str, Any]) -> Decoder:
    return lambda content, most: _whole(lzma.LZMADecompressor(memlimit=_LZMA_MEMORY), content, most)


# -- compressors of numcodecs ----------------------------------------------------------------------------------------


def _claiming(name: str, claimed: Callable[[bytes], int]) -> Callable[[dict[str, Any]], Decoder]:
    """Return a codec of numcodecs whose chunks say how many bytes they stand for."""

    def build(config: dict[str, Any]) -> Decoder:
        codec = require("numcodecs").get_codec({"id": name})

        def decode(content: bytes, most: int) -> bytes:
            if not 0 < (size := claimed(content)) <= most:
                raise CacheError(f"claims to unpack to {size} bytes, but at most {most} are its size")
            return bytes(codec.decode(content))

        return decode

    return build


def _lz4_size(content: bytes) -> int:
    return int(struct.unpack_from("<i", content)[0])


def _blosc_size(content: bytes) -> int:
    _, _, _, itemsize, size, block, packed = struct.unpack_from("<4B3I", content)
    if packed != len(content) or not itemsize or block > max(size, 1) or (size and not block):
        raise CacheError("has a Blosc header that does not fit it")
    return int(size)


def _zstd_size(content: bytes) -> int:
    """Return the size that the only frame claims, once its blocks are found to end with the content."""
    magic, about = struct.unpack_from("<IB", content)
    if magic != 0xFD2FB528 or about & 0x08:
        raise CacheError("is no Zstandard frame")
    single, checksum = bool(about & 0x20), bool(about & 0x04)
    place = 5 + (not single) + (0, 1, 2, 4)[about & 3]
    length = (int(single), 2, 4, 8)[about >> 6]
    if not length:
        raise CacheError("does not say how many bytes it stands for; write it again with a size")
    size = int.from_bytes(content[place : place + length], "little") + (256 if length == 2 else 0)
    place += length
    last = False
    while not last:
        head = int.from_bytes(content[place : place + 3], "little")
        last, kind = bool(head & 1), head >> 1 & 3
        place += 3 + (1 if kind == 1 else head >> 3)  # kind 1: one byte, repeated
        if place > len(content) or kind == 3:
            raise CacheError("ends early")
    if place + 4 * checksum != len(content):
        raise CacheError("has bytes after its end")
    return size


COMPRESSORS: dict[str, Callable[[dict[str, Any]], Decoder]] = {
    "zlib": _zlib,
    "gzip": _gzip,
    "bz2": _bz2,
    "lzma": _lzma,
    "blosc": _claiming("blosc", _blosc_size),
    "zstd": _claiming("zstd", _zstd_size),
    "lz4": _claiming("lz4", _lz4_size),
}

# -- filters ---------------------------------------------------------------------------------------------------------


def _is_dtype(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch(r"[<>|=]?(?:[biu][1248]|f[248])", value) is not None


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < 1e300


def _is_small(value: Any) -> bool:
    return type(value) is int and 0 < value <= 64


# What each filter may be told; numcodecs reverses it, and none makes more than 8 bytes of one.
_SETTINGS: dict[str, dict[str, Callable[[Any], bool]]] = {
    "delta": {"dtype": _is_dtype, "astype": _is_dtype},
    "fixedscaleoffset": {"scale": _is_number, "offset": _is_number, "dtype": _is_dtype, "astype": _is_dtype},
    "quantize": {"digits": _is_small, "dtype": _is_dtype, "astype": _is_dtype},
    "bitround": {"keepbits": _is_small},
    "astype": {"encode_dtype": _is_dtype, "decode_dtype": _is_dtype},
    "shuffle": {"elementsize": _is_small},
    "packbits": {},
    "crc32": {"location": lambda value: value in ("start", "end")},
    "adler32": {"location": lambda value: value in ("start", "end")},
    "fletcher32": {},
}


def _filter(name: str) -> Callable[[dict[str, Any]], Decoder]:
    def build(config: dict[str, Any]) -> Decoder:
        settings = {key: value for key, value in config.items() if key != "id"}
        for key, value in settings.items():
            if key not in _SETTINGS[name] or not _SETTINGS[name][key](value):
                raise CacheError(f"its filter {name} cannot have {key:.50} = {value!s:.100}")

        codec = require("numcodecs").get_codec({"id": name, **settings})

        def decode(content: bytes, most: int) -> bytes:
            decoded = codec.decode(content)
            return decoded.tobytes() if isinstance(decoded, np.ndarray) else bytes(decoded)

        return decode

    return build


FILTERS: dict[str, Callable[[dict[str, Any]], Decoder]] = {name: _filter(name) for name in _SETTINGS}
