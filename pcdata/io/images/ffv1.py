"""The checksums of FFV1 pictures: FFmpeg shows what it can of a damaged one, and fills the rest from the one before.

Source: RFC 9043, FFV1 video coding format versions 0, 1 and 3, section 4.9 (slice footer); version 4 begins its sums
at another number.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import Any

from pcdata.errors import CaptureError

_PLAIN, _SUMMED = 3, 8  # bytes after a slice: its size; and a status and the sum
_BEGINNINGS = (0, 0x7A8C4079)
_MIRRORED = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))


def decoded(container: Any, track: Any) -> Iterator[Any]:
    """Decode a track of any codec from where its container is, a picture of PyAV at a time.

    Raises:
        CaptureError: the sum of an FFV1 picture is not that of its content.
    """
    has_sums = track.codec_context.name == "ffv1" and bool(track.codec_context.extradata)  # version 3 or later
    for packet in container.demux(track):
        if has_sums and packet.size and is_damaged(bytes(packet)):
            raise CaptureError("a picture is damaged: its checksum is not that of its content")
        yield from packet.decode()


def is_damaged(packet: bytes) -> bool:
    """Say whether a coded picture of version 3 or later is damaged, as far as its slices and their sums tell."""
    slices = _slices(packet, _SUMMED)
    if slices is None:
        return _slices(packet, _PLAIN) is None  # without sums nothing more can be told
    return not all(any(_sum(one, begin) == 0 for begin in _BEGINNINGS) for one in slices)


def _slices(packet: bytes, footer: int) -> list[bytes] | None:
    """Return the slices with their footers, which are found from the end; None where they do not fill the picture."""
    found, end = list[bytes](), len(packet)
    while end > 0:
        if end < footer:
            return None
        size = int.from_bytes(packet[end - footer : end - footer + 3], "big") + footer
        if size > end:
            return None
        found.append(packet[end - size : end])
        end -= size
    return found


def _sum(content: bytes, begin: int) -> int:
    """Return the CRC-32 that counts from the highest bit; zlib's counts from the lowest, of mirrored bytes the same."""
    mirrored = int(f"{begin:032b}"[::-1], 2)
    return zlib.crc32(content.translate(_MIRRORED), mirrored ^ 0xFFFFFFFF) ^ 0xFFFFFFFF
