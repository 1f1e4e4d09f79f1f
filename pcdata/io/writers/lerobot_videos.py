"""Videos that grow by one picture at a time, many episodes in one file, as LeRobot keeps them."""

from __future__ import annotations

import importlib
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError
from pcdata.extras import require
from pcdata.io.sources.lerobot_files import VIDEO_PATH

FILES_IN_CHUNK = 1000
FILE_MEGABYTES = 200
# Every picture stands by itself and is found without decoding others; checksums tell damage.
_LOSSLESS = {"level": "3", "slices": "4", "slicecrc": "1", "g": "1"}
_COLOR = {"g": "2", "crf": "18", "bf": "0", "preset": "medium"}  # two pictures a group, as LeRobot's own


class VideoWriter:
    """The pictures of one camera: depth as FFV1 in .mkv files, without loss, or color as H.264 in .mp4 files."""

    def __init__(self, root: Path, key: str, fps: int, *, is_depth: bool) -> None:
        require("av")
        self._av = importlib.import_module("av")
        self._root, self._key, self._fps, self._is_depth = root, key, fps, is_depth
        self._container: Any = None
        self._track: Any = None
        self._path: Path | None = None
        self._file = -1  # number of the file
        self._count = 0  # pictures in it

    def begin_episode(self) -> dict[str, int | float]:
        """Return where the next picture will be: file and second; a file that has grown large is closed before it."""
        # The encoder may hold the first pictures back, so there may be no file yet.
        written = self._path.stat().st_size if self._path is not None and self._path.exists() else 0
        if written >= FILE_MEGABYTES << 20:
            self.close()
        if self._container is None:
            self._file += 1
            self._count = 0
        return {
            "chunk_index": self._file // FILES_IN_CHUNK,
            "file_index": self._file % FILES_IN_CHUNK,
            "from_timestamp": self._count / self._fps,
        }

    def end_episode(self) -> float:
        """Return the second at which the episode ends."""
        return self._count / self._fps

    def add(self, picture: NDArray[Any]) -> None:
        """Add (H, W) uint16 depth or (H, W, 3) uint8 color.

        Raises:
            CaptureError: it has another size than those before it.
        """
        if self._container is None:
            self._open(picture)
        if picture.shape[:2] != (self._track.height, self._track.width):
            raise CaptureError(
                f"{self._key}: has {picture.shape[1]}x{picture.shape[0]} pixels, those before it "
                f"{self._track.width}x{self._track.height}; a video has one size, so write these apart (--only, --skip)"
            )
        if self._is_depth:
            frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="gray16le")
        else:
            rgb = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame = rgb.reformat(format=self._track.pix_fmt)
        frame.pts = self._count
        frame.time_base = Fraction(1, self._fps)
        self._container.mux(self._track.encode(frame))
        self._count += 1

    def close(self) -> None:
        """Write what the encoder still holds, and end the file."""
        container, self._container = self._container, None
        if container is not None:
            try:
                container.mux(self._track.encode(None))
            finally:
                container.close()

    def abandon(self) -> None:
        """End the file without its last pictures, after a failure."""
        container, self._container = self._container, None
        if container is not None:
            container.close()

    def info(self) -> dict[str, Any]:
        """Return what LeRobot records of a video."""
        return {
            "video.height": self._track.height,
            "video.width": self._track.width,
            "video.codec": "h264",
            "video.pix_fmt": self._track.pix_fmt,
            "video.fps": self._fps,
            "video.channels": 3,
            "is_depth_map": False,
            "has_audio": False,
        }

    def _open(self, picture: NDArray[Any]) -> None:
        place = VIDEO_PATH.format(
            video_key=self._key, chunk_index=self._file // FILES_IN_CHUNK, file_index=self._file % FILES_IN_CHUNK
        )
        path = self._root / place
        path = path.with_suffix(".mkv") if self._is_depth else path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        # Without a date and a number that nobody asked for: the same captures give the same bytes.
        exact = {"fflags": "+bitexact"}
        kind = "matroska" if self._is_depth else "mp4"
        self._container = self._av.open(str(path), "w", format=kind, container_options=exact)
        height, width = picture.shape[:2]
        self._track = self._container.add_stream("ffv1" if self._is_depth else "libx264", rate=self._fps)
        self._track.height, self._track.width = height, width
        # Chroma for two pixels each needs even sides.
        self._track.pix_fmt = "gray16le" if self._is_depth else "yuv420p" if not (height | width) & 1 else "yuv444p"
        self._track.options = dict(_LOSSLESS if self._is_depth else _COLOR)
        self._track.time_base = Fraction(1, self._fps)
