"""Pictures of a video by their time, through PyAV: one decoder, which stays open, reads onward or seeks."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError
from pcdata.extras import require
from pcdata.files.library_errors import read_by_library
from pcdata.files.opening import MAX_STREAMED_BYTES, open_input
from pcdata.io.images.ffv1 import decoded
from pcdata.io.images.reading import check_pixels

_MATROSKA = b"\x1a\x45\xdf\xa3"
_ONWARD = 8  # pictures: so many are decoded rather than sought, which decodes from the last that stands by itself
_DEEP = ("gray16le", "gray12le", "gray10le")  # whole numbers in two bytes
_LUMA = ("yuv420p12le", "yuv420p10le")  # the same in the first of three planes


class VideoFile:
    """An open .mp4 or .mkv file; times are seconds on its own clock."""

    def __init__(self, where: str, path: Path, inside: Iterable[Path]) -> None:
        """Open a file.

        Raises:
            CaptureError: it is missing, outside, neither kind of file, damaged or without pictures.
            MissingExtraError: PyAV is not installed.
        """
        require("av")
        av = importlib.import_module("av")
        self._where, self._path = where, path
        with self._named():
            self._stream = open_input(where, path, max_bytes=MAX_STREAMED_BYTES, inside=inside)
            self._container: Any = None
            try:
                start = self._stream.read(12)
                self._stream.seek(0)
                kind = "matroska" if start[:4] == _MATROSKA else "mp4" if start[4:8] == b"ftyp" else None
                if kind is None:
                    raise CaptureError("it begins as neither an .mp4 nor an .mkv file does")
                # No other format, and no other file, is opened.
                self._container = av.open(self._stream, mode="r", format=kind)
                if len(self._container.streams.video) != 1:
                    raise CaptureError(f"it holds {len(self._container.streams.video)} tracks of pictures, not one")
                self._track = self._container.streams.video[0]
                self._unit = float(self._track.time_base or math.nan)
                rate = float(self._track.average_rate or math.nan)
                if not (0 < self._unit < math.inf and 0 < rate < math.inf):
                    raise CaptureError("it states no unit of time, or no rate of its pictures")
                self._period = 1.0 / rate
                self._track.codec_context.thread_count = 1  # workers are many
                check_pixels("its pictures", self._track.width, self._track.height)
            except BaseException:
                self.close()
                raise
        self._frames: Iterator[Any] | None = None
        self._last: tuple[float, Any] | None = None

    def close(self) -> None:
        """Close the file."""
        if self._container is not None:
            self._container.close()
        self._stream.close()

    def color(self, seconds: float) -> NDArray[np.uint8]:  # (H, W, 3)
        """Return the picture of a time as RGB.

        Raises:
            CaptureError: there is none within half the time from one to the next, or it is damaged.
        """
        with self._named():
            frame = self._at(seconds)
            return np.asarray(frame.to_ndarray(format="rgb24"))

    def deep(self, seconds: float) -> tuple[NDArray[np.uint16], str]:  # (H, W), pixel format
        """Return the picture of a time as the whole numbers that are stored, and in which format they are.

        Raises:
            CaptureError: as :meth:`color`; or its pixels have 8 bits or colors, which are no depth.
        """
        with self._named():
            frame = self._at(seconds)
            kind = str(frame.format.name)
            if kind not in (*_DEEP, *_LUMA):
                raise CaptureError(
                    f"it holds {kind} pictures; depth has gray pixels of 10 bits or more: {', '.join(_DEEP)}. Is it a "
                    "picture of the depth made for viewing? Its values are no lengths"
                )
            plane = frame.planes[0]
            rows = np.frombuffer(plane, "<u2").reshape(frame.height, plane.line_size // 2)
            return rows[:, : frame.width].copy(), kind

    def _at(self, seconds: float) -> Any:
        if not math.isfinite(seconds) or abs(seconds) > 1e9:
            raise CaptureError(f"there is no picture at {seconds} s")
        half = self._period / 2
        if self._last is not None and abs(self._last[0] - seconds) < half:
            return self._last[1]
        onward = self._last is not None and 0 < seconds - self._last[0] < _ONWARD * self._period
        if not onward or self._frames is None:
            self._container.seek(round(seconds / self._unit), stream=self._track, backward=True)
            self._frames = decoded(self._container, self._track)
        nearest = math.inf
        for frame in self._frames:
            if frame.pts is None:
                continue
            time = frame.pts * self._unit
            self._last = (time, frame)
            nearest = min(nearest, abs(time - seconds))
            if time > seconds - half:
                break
        self._frames = self._frames if nearest < math.inf else None
        if self._last is None or not abs(self._last[0] - seconds) <= half + self._unit:
            found = "none" if nearest == math.inf else f"the nearest is {nearest:.6g} s off"
            self._last = self._frames = None
            raise CaptureError(f"has no picture at {seconds:.6f} s, {found}; is the file cut short?")
        frame = self._last[1]
        if frame.is_corrupt:
            raise CaptureError(f"the picture at {seconds:.6f} s is damaged")
        check_pixels("its pictures", frame.width, frame.height)
        return frame

    def _named(self) -> AbstractContextManager[None]:
        return read_by_library(self._where, self._path, "video")
