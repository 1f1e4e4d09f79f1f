"""One channel of an OpenEXR file, whose structure is checked before the library decodes it.

Source: OpenEXR, "The OpenEXR File Layout" (header attributes, offset table, scan line blocks and tiles).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError, PcdataError
from pcdata.extras import require
from pcdata.files.library_errors import WRITE_AGAIN, told_by_library
from pcdata.files.opening import read_bytes

MAGIC = b"\x76\x2f\x31\x01"
_MAX_BYTES = 1 << 29
_MAX_HEADER = 1 << 16
_LINES = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}  # of a block, by the way it is packed
_TYPES = {0: 4, 1: 2, 2: 4}  # bytes of uint, half, float
_USUAL = ("Z", "Y", "depth", "R")  # names of the channel that holds depth, the likeliest first
_MOST_CHANNELS = 8


def read_exr_channel(where: str, path: Path, max_pixels: int) -> NDArray[np.float32]:  # (H, W)
    """Return the depth of a scan line EXR image: its only channel, Z, or one of several that are all the same.

    Raises:
        CaptureError: the file is missing, damaged, cut short, too large, of several parts or tiled, or holds channels
            that differ and of which none is depth by its name.
        MissingExtraError: OpenEXR is not installed.
    """
    data = read_bytes(where, path, max_bytes=_MAX_BYTES)
    try:
        _check_structure(data, max_pixels)
    except (struct.error, ValueError, KeyError) as error:
        if isinstance(error, PcdataError):
            raise
        raise CaptureError(f"{where}: not a readable OpenEXR image: {str(error) or 'its header is damaged'}") from error
    library = require("OpenEXR")
    try:
        with library.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(one.pixels) for name, one in file.channels().items()}
    except Exception as error:  # its bindings raise RuntimeError and others on damaged blocks
        raise CaptureError(f"{where}: not a readable OpenEXR image: {told_by_library(error)}; {WRITE_AGAIN}") from error
    return _one_channel(where, channels)


def exr_size(where: str, header: bytes) -> tuple[int, int]:
    """Return (height, width) of an image from the beginning of its file.

    Raises:
        CaptureError: it is not the beginning of such a file.
    """
    try:
        left, top, right, bottom = struct.unpack("<4i", _attributes(header, 8)[0]["dataWindow"])
    except (struct.error, ValueError, KeyError) as error:
        raise CaptureError(f"{where}: not a readable OpenEXR image: its header is damaged") from error
    return bottom - top + 1, right - left + 1


def _one_channel(where: str, channels: dict[str, NDArray[Any]]) -> NDArray[np.float32]:
    named = [name for usual in _USUAL for name in channels if name.rpartition(".")[2].lower() == usual.lower()]
    first = named[0] if named else next(iter(channels))
    depth = channels[first]
    if len(channels) > 1 and first not in ("Z", "depth"):
        others = [name for name, other in channels.items() if name != "A" and not np.array_equal(other, depth, True)]
        if others:
            raise CaptureError(
                f"{where}: has the channels {', '.join(channels)}, which differ, and none is called Z; is it a picture?"
            )
    if depth.ndim != 2 or depth.dtype.kind not in "fu":
        raise CaptureError(f"{where}: channel {first} must be (H, W) numbers, got {depth.dtype} {depth.shape}")
    return depth.astype(np.float32)


def _check_structure(data: bytes, max_pixels: int) -> None:
    """Require one part of scan lines whose blocks lie in the file one after the other."""
    if data[:4] != MAGIC:
        raise ValueError("it does not start as an OpenEXR file does")
    (version,) = struct.unpack_from("<I", data, 4)
    if version & 0xFF != 2 or version & 0x1A00:
        raise ValueError("it has tiles, several parts or deep data; store one image of scan lines")
    attributes, start = _attributes(data, 8)
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    if not (width > 0 and height > 0 and width * height <= max_pixels):
        raise ValueError(f"an image must have 1 .. {max_pixels} pixels, this one claims {width}x{height}")
    pixel = sum(_channel_sizes(attributes["channels"]))
    packing = attributes["compression"][0]
    if packing not in _LINES:
        raise ValueError(f"it is packed in a way that is not known, number {packing}")
    count = -(-height // _LINES[packing])
    offsets = struct.unpack_from(f"<{count}Q", data, start)
    first = start + 8 * count
    for offset in offsets:
        if not first <= offset <= len(data) - 8:
            raise ValueError(f"it is cut short: a block should be at byte {offset} of {len(data)}")
        line, size = struct.unpack_from("<iI", data, offset)
        lines = min(_LINES[packing], bottom - line + 1)
        if not top <= line <= bottom or offset + 8 + size > len(data) or size > width * lines * pixel:
            raise ValueError(f"the block at byte {offset} claims line {line} and {size} bytes; the file is damaged")
    if len(set(offsets)) != count:
        raise ValueError("its table names one block twice")


def _attributes(data: bytes, start: int) -> tuple[dict[str, bytes], int]:
    found: dict[str, bytes] = {}
    while data[start : start + 1] != b"\0":
        name, start = _text(data, start)
        _, start = _text(data, start)
        (size,) = struct.unpack_from("<I", data, start)
        if start + 4 + size > min(len(data), _MAX_HEADER):
            raise ValueError("its header is cut short or longer than any")
        found[name] = data[start + 4 : start + 4 + size]
        start += 4 + size
    return found, start + 1


def _text(data: bytes, start: int) -> tuple[str, int]:
    end = data.find(b"\0", start, start + 256)
    if end < 0:
        raise ValueError("its header is cut short")
    return data[start:end].decode("ascii", "replace"), end + 1


def _channel_sizes(content: bytes) -> list[int]:
    sizes, start = list[int](), 0
    while content[start : start + 1] != b"\0":
        _, start = _text(content, start)
        kind, _, across, down = struct.unpack_from("<iIii", content, start)
        if across != 1 or down != 1:
            raise ValueError("a channel has fewer pixels than the image")
        sizes.append(_TYPES[kind])
        start += 16
        if len(sizes) > _MOST_CHANNELS:
            raise ValueError(f"it has more than {_MOST_CHANNELS} channels")
    return sizes
