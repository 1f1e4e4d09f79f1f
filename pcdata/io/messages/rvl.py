"""RVL: 16-bit depth packed as runs of zeros, runs of readings, and the differences from one reading to the next.

Source: Wilson, "Fast lossless depth image compression", ISS 2017.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError

_LONGEST = 11  # groups of three bits that 32 bits take


def unpacked_rvl(content: bytes, num_pixels: int) -> NDArray[np.uint16]:  # (num_pixels,)
    """Return the pixels.

    Raises:
        CaptureError: they are fewer or more, or the bytes are no RVL.
    """
    values = _numbers(content[: len(content) // 4 * 4])
    pixels = np.zeros(num_pixels, np.uint16)
    at = place = 0
    last = 0
    while at < num_pixels:
        if place + 2 > len(values):
            raise CaptureError(f"RVL ends after {at} of {num_pixels} pixels; the image is damaged")
        zeros, readings = int(values[place]), int(values[place + 1])
        coded = values[place + 2 : place + 2 + readings]
        if zeros + readings == 0 or at + zeros + readings > num_pixels or len(coded) != readings:
            raise CaptureError(f"an RVL run leaves the image after {at} of {num_pixels} pixels; it is damaged")
        at += zeros
        if readings:
            run = last + np.cumsum((coded >> 1) ^ -(coded & 1))
            last = int(run[-1]) & 0xFFFF
            pixels[at : at + readings] = run & 0xFFFF
        at, place = at + readings, place + 2 + readings
    return pixels


def _numbers(content: bytes) -> NDArray[np.int64]:
    """Return numbers of any length: three bits in four, the fourth says that more follow, the lowest three first.

    Eight groups fill a word of 32 bits, the first in its highest bits; words are little-endian.
    """
    words = np.frombuffer(content, "<u4")
    groups = ((words[:, None] >> np.arange(28, -4, -4, dtype=np.uint32)) & 0xF).reshape(-1).astype(np.int64)
    ends = np.flatnonzero(groups < 8)
    if not len(ends):
        return np.empty(0, np.int64)
    starts = np.concatenate([[0], ends[:-1] + 1])
    if (ends - starts).max() >= _LONGEST:
        raise CaptureError("an RVL number has more than 32 bits; the image is damaged")
    groups = groups[: ends[-1] + 1]
    position = np.arange(len(groups)) - np.repeat(starts, ends - starts + 1)
    parts = (groups & 7) << (3 * position)
    return np.add.reduceat(parts, starts)
