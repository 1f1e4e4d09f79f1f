"""Tracks, packets and attachments of a Matroska file, read one packet at a time through PyAV."""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError, PcdataError
from pcdata.extras import require
from pcdata.files.library_errors import name_file, told_by_library
from pcdata.files.opening import MAX_STREAMED_BYTES, open_input
from pcdata.io.images.ffv1 import decoded
from pcdata.io.images.reading import check_pixels

MAGIC = b"\x1a\x45\xdf\xa3"
_SEGMENT = b"\x18\x53\x80\x67"  # the name of what holds all tracks
_MAX_ATTACHMENT = 1 << 24
_MAX_TRACKS = 64
_GRAY, _GRAYS = "gray16le", ("gray16le", "gray16be")  # converting others to it would invent numbers


class _Matroska:
    """An open recording; times are seconds on its own clock."""

    def __init__(self, container: Any, missing: int) -> None:
        if len(container.streams) > _MAX_TRACKS:
            raise CaptureError(f"it has {len(container.streams)} tracks; no recorder writes so many")
        self._container = container
        self.missing = missing  # bytes that the file says it has and has not: it is cut short

    def tracks(self) -> dict[str, dict[str, str]]:
        """Return the tags of every picture track, by its title."""
        return {str(one.metadata.get("title", one.index)): dict(one.metadata) for one in self._container.streams.video}

    def tags(self) -> dict[str, str]:
        """Return the tags of the recording."""
        return dict(self._container.metadata)

    def attachment(self, name: str) -> bytes:
        """Return an attached file.

        Raises:
            CaptureError: there is none of this name.
        """
        for stream in self._container.streams:
            if stream.type == "attachment" and stream.metadata.get("filename") == name:
                content = bytes(stream.data)
                if len(content) <= _MAX_ATTACHMENT:
                    return content
        raise CaptureError(f"it has no attachment {name}")

    def times(self, *titles: str) -> list[list[float]]:
        """Return when each picture of some tracks was taken, in order; one pass over the file that decodes nothing."""
        streams = [self._track(title) for title in titles]
        found: dict[int, list[float]] = {stream.index: [] for stream in streams}
        for packet in self._container.demux(streams):
            if packet.pts is not None and packet.size:
                found[packet.stream.index].append(packet.pts * float(packet.stream.time_base))
        return [sorted(found[stream.index]) for stream in streams]

    def picture(self, title: str, time: float, pixels: str) -> NDArray[Any]:  # (H, W) uint16, or (H, W, 3) uint8
        """Return the picture of a track that was taken at a time, as ``gray16le`` or ``rgb24``.

        Raises:
            CaptureError: there is none, it is damaged, or its size is none of a camera.
        """
        stream = self._track(title)
        tick = round(time / float(stream.time_base))
        check_pixels(f"track {title}", stream.width, stream.height)
        self._container.seek(tick, stream=stream, backward=True)
        for frame in decoded(self._container, stream):  # from the last picture before it that stands by itself
            if frame.pts is None or frame.pts < tick:
                continue
            if frame.pts > tick or frame.is_corrupt:
                break
            check_pixels(f"track {title}", frame.width, frame.height)
            if pixels == _GRAY and frame.format.name not in _GRAYS:
                raise CaptureError(f"track {title} holds {frame.format.name} pictures, not 16-bit gray ones")
            return np.asarray(frame.to_ndarray(format=pixels))
        raise CaptureError(f"track {title} has no whole picture at {time:.6f} s; the file is cut short or damaged")

    def _track(self, title: str) -> Any:
        for stream in self._container.streams.video:
            if stream.metadata.get("title", str(stream.index)) == title:
                if not math.isfinite(float(stream.time_base or math.nan)):
                    raise CaptureError(f"track {title} states no unit of time")
                return stream
        raise CaptureError(f"it has no track {title}; it has {', '.join(self.tracks()) or 'none'}")


def _missing_bytes(stream: BinaryIO) -> int:
    """Return how many bytes the one segment of a file ends beyond it; 0 where its length was not written.

    Source: RFC 8794, Extensible Binary Meta Language: an element is its name, its length and that many bytes.
    """
    stream.seek(len(MAGIC))
    stream.seek(_length(stream) or 0, os.SEEK_CUR)  # over the header
    if stream.read(len(_SEGMENT)) != _SEGMENT or (length := _length(stream)) is None:
        return 0
    return max(0, stream.tell() + length - os.fstat(stream.fileno()).st_size)


def _length(stream: BinaryIO) -> int | None:
    """Read a length: as many bytes as the first has zeros before its first 1, all ones = unknown."""
    first = (stream.read(1) or b"\0")[0]
    if not first:
        return None
    count = 8 - first.bit_length()
    rest = stream.read(count)
    value = int.from_bytes(bytes([first ^ (1 << (7 - count))]) + rest, "big")
    return None if len(rest) < count or value == (1 << 7 * (count + 1)) - 1 else value


@contextmanager
def opened_matroska(where: str, path: Path) -> Iterator[_Matroska]:
    """Open a recording.

    Raises:
        CaptureError: the file is missing, no Matroska file or damaged, also while it is used.
        MissingExtraError: PyAV is not installed.
    """
    require("av")
    av = importlib.import_module("av")
    try:
        with open_input(where, path, max_bytes=MAX_STREAMED_BYTES) as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise CaptureError("it does not start as a Matroska file does")
            missing = _missing_bytes(stream)
            stream.seek(0)
            with av.open(
                stream, mode="r", format="matroska"
            ) as container:  # no other format, and no other file, is opened
                yield _Matroska(container, missing)
    except PcdataError as error:
        name_file(error, path, where)
        raise
    except Exception as error:  # FFmpeg's errors are of many types, some of them of Python's own
        raise CaptureError(
            f"{where}: not a readable recording: {told_by_library(error)}; the file is damaged or cut short: copy it "
            "again from where it was recorded"
        ) from error
