"""Packed parts of recordings, unpacked no further than the size that they claim."""

from __future__ import annotations

import bz2
import importlib
import zlib
from functools import cache
from typing import Any

from pcdata.errors import CaptureError
from pcdata.files.recent import Recent

_PACKINGS = ("none", "bz2", "lz4", "zstd")
MAX_CHUNK = 1 << 28  # bytes of messages packed together: recorders' default is about 1 MB, or one image if larger


# The images and joints of one moment lie in a few chunks, and those of the next in the last of these.
UNPACKED = Recent(1 << 24)


def unpacked(content: bytes, compression: str, size: int, checksum: int = 0) -> bytes:
    """Unpack a chunk of messages.

    Args:
        content: the packed bytes.
        compression: "none", "bz2", "lz4" or "zstd".
        size: in bytes, that the file says it unpacks to.
        checksum: CRC-32 of the unpacked bytes; 0 = not stated.

    Raises:
        CaptureError: it is damaged, goes on, is packed in another way, or claims too much.
    """
    check_packing(compression, size)
    most = size + 1
    try:
        if compression == "none":
            found = content
        elif compression == "bz2":
            found = bz2.BZ2Decompressor().decompress(content, most)
        elif compression == "lz4":
            found = importlib.import_module("lz4.frame").LZ4FrameDecompressor().decompress(content, most)
        else:
            found = unpacked_zstd(content, most)
    except CaptureError:
        raise
    except (OSError, ValueError, RuntimeError, EOFError, MemoryError) as error:
        raise CaptureError(f"a packed chunk is damaged: {str(error) or type(error).__name__}") from error
    if len(found) != size:
        more = "more than" if len(found) > size else f"{len(found)} of"
        raise CaptureError(f"a chunk unpacks to {more} the {size} bytes it claims; the bag is damaged")
    if checksum and zlib.crc32(found) != checksum:
        raise CaptureError("a chunk's checksum is not that of its content; the file is damaged")
    return found


def check_packing(compression: str, size: int) -> None:
    """Require a way of packing that is known, and a size that a chunk may have.

    Raises:
        CaptureError: it is another one, or larger.
    """
    if compression not in _PACKINGS:
        raise CaptureError(f"a chunk is packed with {compression[:20]!r}; known are {', '.join(_PACKINGS)}")
    if size > MAX_CHUNK:
        raise CaptureError(f"a chunk claims {size} bytes, the limit is {MAX_CHUNK}")


def unpacked_zstd(content: bytes, most: int) -> bytes:
    """Unpack Zstandard, at most so many bytes.

    Raises:
        CaptureError: it is damaged, or no package that unpacks it is there.
    """
    zstd = _zstd()
    try:
        if hasattr(zstd, "ZstdCompressor") and hasattr(zstd, "CompressionParameter"):
            return bytes(zstd.ZstdDecompressor().decompress(content, most))
        with zstd.ZstdDecompressor().stream_reader(content) as stream:  # the package zstandard
            return bytes(stream.read(most))
    except Exception as error:  # each package has an error class of its own
        raise CaptureError(f"a packed chunk is damaged: {str(error) or type(error).__name__}") from error


@cache  # a module that is not there is looked for each time
def _zstd() -> Any:
    for name in ("compression.zstd", "backports.zstd", "zstandard"):
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    raise CaptureError('a chunk is packed with zstd; pip install "pcdata[ros]" brings what unpacks it')
