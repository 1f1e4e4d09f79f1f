"""Depth and color images of a LeRobot dataset, wherever they are stored: videos, rows, or raw files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError, PcdataError, UnitError, add_note
from pcdata.files.handles import Handles
from pcdata.files.opening import MAX_STREAMED_BYTES, open_input, read_bytes
from pcdata.functional.depth.stored_depth import check_plausible, clean_float_depth, metres_of_numbers
from pcdata.functional.depth.unit_fit import DepthUnit
from pcdata.io.images.reading import check_pixels, decode_color, decode_raw_depth
from pcdata.io.images.video import VideoFile
from pcdata.io.sources.lerobot_cameras import DepthStream
from pcdata.io.sources.lerobot_index import RecordedEpisode

Row = Callable[[RecordedEpisode, int, Sequence[str]], Mapping[str, Any]]

_MAX_IMAGE = 1 << 28


class Pictures:
    """The images of a dataset; the videos that were used last stay open, in each process its own."""

    def __init__(self, where: str, root: Path, inside: Sequence[Path]) -> None:
        self._where, self._root, self._inside = where, root, inside
        self._videos = Handles(16)

    def file_of(self, stream: DepthStream, key: str, episode: RecordedEpisode) -> str | None:
        """Return the file of its own that images are in, from the folder of the dataset; None = the rows."""
        if key == stream.key and stream.files:
            return stream.files.get(episode.number)
        video = episode.videos.get(key)
        return video[0] if video is not None else None

    def depth(
        self, stream: DepthStream, episode: RecordedEpisode, step: int, row: Row, invalid: Sequence[int]
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Return the depth of a step as metres, 0 = no reading, and what is told of it.

        Raises:
            CaptureError: it is missing, damaged, no depth, or has no reading.
            UnitError: half of the readings are where no depth camera sees.
        """
        where = f"{self._where}: depth {stream.key} of episode {episode.number}, step {step}"
        stored = self.stored(stream, episode, step, row)
        unit = 1.0 if stream.quantized is not None else stream.metres_per_unit
        if unit is None:
            raise UnitError(f"{where}: nothing states its unit")
        if stream.quantized is not None:
            depth = stream.quantized.decoded(stored)
            check_plausible(where, depth, DepthUnit(1.0), depth)
            error = round(1000 * stream.quantized.error(float(depth.max())), 6)
            bound = error if stream.facts.get("codec_is_lossless") else None  # what a codec took has none
            return depth, {**stream.facts, "depth_encoding": "quantized", "depth_error_mm": bound}
        if stored.dtype == np.uint16:
            depth = metres_of_numbers(stored, unit, invalid)
        else:
            depth = clean_float_depth(where, stored, unit, invalid)
        check_plausible(where, depth, DepthUnit(unit), stored)
        return depth, {**stream.facts, "metres_per_unit": unit, "unit_is_recorded": True}

    def stored(self, stream: DepthStream, episode: RecordedEpisode, step: int, row: Row) -> NDArray[Any]:
        """Return the numbers of a depth image as they are stored, (H, W).

        Raises:
            CaptureError: they are missing, damaged, or of another size than is stated.
        """
        where = f"{self._where}: depth {stream.key} of episode {episode.number}, step {step}"
        try:
            found = self._stored(where, stream, episode, step, row)
        except PcdataError as error:
            add_note(error, f"while reading {where}")
            raise
        if stream.size is not None and found.shape != stream.size:
            raise CaptureError(
                f"{where}: has {found.shape[1]}x{found.shape[0]} pixels, but its feature says "
                f"{stream.size[1]}x{stream.size[0]}"
            )
        return found

    def _stored(self, where: str, stream: DepthStream, episode: RecordedEpisode, step: int, row: Row) -> NDArray[Any]:
        if stream.storage == "video":
            file, seconds = self._video(where, stream, episode, step)
            with self._opened(file) as video:
                values, kind = video.deep(seconds)
            if kind == "gray16le" and stream.quantized is not None:
                raise CaptureError(
                    f"{where}: is stored in 16 bits, but its feature says that it is quantized to 12; leave the flag "
                    "is_depth_map out of meta/info.json and say metres_per_unit"
                )
            if kind != "gray16le" and stream.quantized is None:
                raise CaptureError(
                    f"{where}: holds {kind} codes, but its feature does not say for which depths they stand "
                    "(is_depth_map, video.depth_min, video.depth_max)"
                )
            return values
        if stream.storage == "raw":
            return self._raw(where, stream, episode, step)
        values = row(episode, step, [stream.key])[stream.key]
        if stream.storage == "image":
            return decode_raw_depth(where, self._content(where, values))
        return _array(where, stream, values)

    def color(self, key: str, episode: RecordedEpisode, step: int, row: Row) -> NDArray[np.uint8]:  # (H, W, 3)
        """Return the color image of a step.

        Raises:
            CaptureError: it is missing, damaged, or no color image.
        """
        where = f"{self._where}: color {key} of episode {episode.number}, step {step}"
        if key in episode.videos:
            file, seconds = _time(where, key, episode, step)
            with self._opened(file) as video:
                return video.color(seconds)
        return decode_color(where, self._content(where, row(episode, step, [key])[key]))

    def beside(self, key: str, episode: RecordedEpisode, step: int) -> NDArray[np.uint16]:  # (H, W)
        """Return the whole numbers of a lossless video that is no feature, such as that of labels.

        Raises:
            CaptureError: it is missing or damaged, or has not 16 bits.
        """
        where = f"{self._where}: {key} of episode {episode.number}, step {step}"
        file, seconds = _time(where, key, episode, step)
        with self._opened(file) as video:
            values, kind = video.deep(seconds)
        if kind != "gray16le":
            raise CaptureError(f"{where}: must be stored in 16 bits, but is {kind}")
        return values

    def _video(self, where: str, stream: DepthStream, episode: RecordedEpisode, step: int) -> tuple[str, float]:
        if not stream.files:
            return _time(where, stream.key, episode, step)
        if episode.number not in stream.files:
            raise CaptureError(f"{where}: there is no video of this episode; leave it out")
        return stream.files[episode.number], episode.seconds[step]

    def _opened(self, file: str) -> Any:
        return self._videos.using(file, lambda: VideoFile(self._where, self._root / file, self._inside))

    def _raw(self, where: str, stream: DepthStream, episode: RecordedEpisode, step: int) -> NDArray[np.uint16]:
        file = stream.files.get(episode.number)
        if file is None or stream.size is None:
            raise CaptureError(f"{where}: there is no file of this episode; leave it out")
        height, width = stream.size
        check_pixels(where, width, height)
        size = 2 * height * width
        with open_input(where, self._root / file, max_bytes=MAX_STREAMED_BYTES, inside=self._inside) as opened:
            opened.seek(0, 2)
            if opened.tell() != size * episode.length:
                raise CaptureError(
                    f"{where}: {file}: {episode.length} images of {width}x{height} pixels take {size * episode.length} "
                    f"bytes, but it has {opened.tell()}"
                )
            opened.seek(size * step)
            content = opened.read(size)
        return np.frombuffer(content, "<u2").reshape(height, width).copy()

    def _content(self, where: str, value: Any) -> bytes:
        """Return the bytes of an image in a row: in it, or in a file that it names."""
        if isinstance(value, bytes):
            return value
        if not isinstance(value, dict):
            raise CaptureError(f"{where}: an image must be stored as bytes or the path of a file, got {value!r:.100}")
        content, path = value.get("bytes"), value.get("path")
        if isinstance(content, bytes):
            return content
        if not isinstance(path, str) or not path:
            raise CaptureError(f"{where}: has neither the bytes of the image nor the path of its file")
        return read_bytes(where, self._root / path, max_bytes=_MAX_IMAGE, inside=self._inside)


def _time(where: str, key: str, episode: RecordedEpisode, step: int) -> tuple[str, float]:
    """Return the video that a step is in, and its second there."""
    if key not in episode.videos:
        raise CaptureError(f"{where}: meta/episodes does not say where its video is")
    file, begin, end = episode.videos[key]
    seconds = begin + episode.seconds[step]
    last = begin + episode.seconds[-1]
    # What follows in the file is of another episode; and steps before it are at the wrong pictures if the last is.
    if not (seconds < end and last < end):
        raise CaptureError(
            f"{where}: is at {seconds:g} s of {file}, and the last step at {last:g} s, but the video of its episode "
            f"ends at {end:g} s"
        )
    return file, seconds


def _array(where: str, stream: DepthStream, values: Any) -> NDArray[Any]:
    if stream.size is None or not isinstance(values, np.ndarray) or values.size != stream.size[0] * stream.size[1]:
        found = values.size if isinstance(values, np.ndarray) else type(values).__name__
        raise CaptureError(f"{where}: must hold an image of {stream.size} numbers as its feature says, got {found}")
    check_pixels(where, stream.size[1], stream.size[0])
    image = values.reshape(stream.size)
    if image.dtype.kind == "f":
        return image
    if image.dtype.kind == "b" or image.dtype.itemsize < 2:
        raise CaptureError(f"{where}: holds {image.dtype} numbers; a picture of the depth in 8 bits holds no lengths")
    if image.min() < 0 or image.max() > 65535:
        raise CaptureError(f"{where}: must lie in 0 .. 65535, got {image.min()} .. {image.max()}")
    return image.astype(np.uint16)
