"""Recordings: one file with the streams of one depth camera and its color camera, whatever container they are in.

A layout of this kind says how its file begins, what it states, and how one image is read; choosing the file, joining
the streams by time and registering are the same for all.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CaptureError
from pcdata.files.opening import MAX_STREAMED_BYTES, check_inside, open_input
from pcdata.files.sample_names import name_some
from pcdata.functional.depth.stored_depth import check_plausible, metres_of_numbers
from pcdata.functional.depth.unit_fit import DepthUnit
from pcdata.io.sources.listing import LinkTargets, absolute, check_links, entries, is_folder, link_targets
from pcdata.io.sources.option_checks import check_seconds, check_switch
from pcdata.io.sources.source import Source
from pcdata.io.sources.synchronized import allow_more, nearest
from pcdata.structures import Camera, DepthFrame, register_to_color

READ_COLOR = "registered=True (--registered) reads it"  # what to do about a color stream that is not read


@dataclass(frozen=True, eq=False)
class Recorded:
    """What a recording states.

    Args:
        depth_times: of every depth image, in ticks (``ticks_per_second``); whole ones where the container counts so.
        color_times: of every color image; none unless they are to be registered.
        metres_per_unit: length of one stored depth unit.
        sensor: of ``sensor_name`` and ``serial`` what is known.
        unread: the streams that are not read, in words.
    """

    depth_times: Sequence[float]
    color_times: Sequence[float]
    metres_per_unit: float
    sensor: dict[str, str]
    unread: list[str]


@dataclass(frozen=True, eq=False)
class Taken:
    """One depth image and its camera; where it is to be registered, also a color image, its camera and its place.

    Args:
        units: (H, W) uint16.
        camera: of the depth image.
        color: (H, W, 3) uint8, its camera, and the (4, 4) color from depth.
    """

    units: NDArray[Any]
    camera: Camera
    color: tuple[NDArray[Any], Camera, Tensor] | None


class RecordingSource(Source):
    """The depth images of one recording, in the order of time; with ``registered`` as the color camera sees them.

    Without it nothing is resampled and the color images, which lie on another grid, are left out.
    """

    is_one_recording = True
    suffix: ClassVar[str]  # of the file's name, in lower case
    role: ClassVar[str]  # what ``files`` calls the file
    ticks_per_second: ClassVar[float]

    def __init__(
        self,
        path: Path,
        *,
        registered: bool = False,
        max_time_apart: float = 0.034,
        links_to: LinkTargets = (),
    ) -> None:
        """Read the calibration, the depth unit and the times.

        Args:
            path: the file, or a folder that holds one such file.
            registered: register each depth image to the color image nearest in time; those without one within
                ``max_time_apart`` are left out, and ``skipped`` tells which.
            max_time_apart: seconds; the default is one frame at 30 Hz.
            links_to: folders outside that a link to the recording, in the folder that is given, may lead to.

        Raises:
            CaptureError: no recording or several, damaged, without depth or calibration, not of one depth camera, or no
                depth has a color image near enough.
            UnitError: the recording states no depth unit.
            IntrinsicsError: a camera's numbers are impossible, or its lens model is not one of OpenCV's.
            MissingExtraError: the package that reads such files is not installed.
        """
        path = absolute(path)
        where = f"{self.kind} source {path}"
        check_switch(where, "registered", registered)
        limit = check_seconds(where, "max_time_apart", max_time_apart)
        if is_folder(path):
            folder, path = path, self._only_recording(where, path)
            check_inside(where, path, [folder, *link_targets(links_to)])
        self._recorded = self._open(where, path, registered)
        self.metres_per_unit, self.sensor = self._recorded.metres_per_unit, self._recorded.sensor
        numbers = range(len(self._recorded.depth_times))
        self._partners: dict[int, int] = {}  # number of the depth image -> number of its color image
        skipped: dict[str, str] = {}
        if registered:
            self._partners, skipped = self._nearest_colors(where, limit)
        super().__init__(path, [_name(number) for number in (self._partners if registered else numbers)], links_to)
        self._skipped = skipped

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """A file that begins as such a recording does, or a folder with one."""
        try:
            return any(map(cls._is_recording, cls._candidates(path) if is_folder(path) else [path]))
        except CaptureError:
            return False

    @classmethod
    @abstractmethod
    def _begins_so(cls, stream: BinaryIO) -> bool:
        """Say whether a file begins as such a recording does."""

    @abstractmethod
    def _open(self, where: str, path: Path, registered: bool) -> Recorded:
        """Read all but the images.

        Raises:
            PcdataError: the recording lacks something, or states what cannot be.
        """

    @abstractmethod
    def _take(self, depth: int, color: int | None) -> Taken:
        """Read the depth image of a number, and the color image to register it to."""

    def files(self, sample_id: str) -> dict[str, Path]:
        """Return the recording, which holds every sample."""
        return {self.role: self.path}

    def unread(self) -> list[str]:
        """Name the streams of the recording that are not read, that of color among them unless ``registered``."""
        return list(self._recorded.unread)

    def _times(self) -> dict[str, float]:
        return {name: self._recorded.depth_times[int(name)] / self.ticks_per_second for name in self._ids}

    def _load(self, sample_id: str) -> DepthFrame:
        number = int(sample_id)
        partner = self._partners.get(number)
        taken = self._take(number, partner)
        depth = metres_of_numbers(taken.units, self.metres_per_unit, ())
        check_plausible(str(self), depth, DepthUnit(self.metres_per_unit), taken.units)
        time = self._recorded.depth_times[number]
        frame = DepthFrame(
            depth=torch.from_numpy(depth)[None],
            camera=taken.camera,
            sample_id=sample_id,
            capture_index=number,
            provenance={
                **self.provenance(sample_id),
                "metres_per_unit": self.metres_per_unit,
                "unit_is_recorded": True,
                "timestamps": [time / self.ticks_per_second],
                **self.sensor,
            },
        )
        if partner is None or taken.color is None:
            return frame
        colors, camera, color_from_depth = taken.color
        seen = register_to_color(frame, torch.from_numpy(colors)[None], camera, color_from_depth)
        later = (self._recorded.color_times[partner] - time) / self.ticks_per_second
        return replace(seen, provenance={**seen.provenance, "color_seconds_later": later})

    @classmethod
    def _is_recording(cls, path: Path) -> bool:
        try:
            with open_input("recognizes", path, max_bytes=MAX_STREAMED_BYTES) as stream:
                return cls._begins_so(stream)
        except (CaptureError, OSError):
            return False

    @classmethod
    def _candidates(cls, folder: Path) -> list[Path]:
        return [entry for entry in entries(folder) if entry.suffix.lower() == cls.suffix]

    @classmethod
    def _only_recording(cls, where: str, folder: Path) -> Path:
        found = cls._candidates(folder)
        check_links(found)
        recordings = [file for file in found if cls._is_recording(file)]
        if not recordings:
            raise CaptureError(f"{where}: holds no recording; this layout needs {cls.needs}")
        if len(recordings) > 1:
            names = name_some(file.name for file in recordings)
            raise CaptureError(
                f"{where}: holds {len(recordings)} recordings, {names}; give the path of one, or "
                f"'{folder}/*{cls.suffix}' for all"
            )
        return recordings[0]

    def _nearest_colors(self, where: str, limit: float) -> tuple[dict[int, int], dict[str, str]]:
        """Return the color image nearest in time for each depth image that has one, and of the others why not."""
        depth, color = self._recorded.depth_times, self._recorded.color_times
        first = min([*depth, *color], default=0)  # nanoseconds since 1970 are more than a float64 can hold exactly
        found = nearest(
            [time - first for time in depth], [time - first for time in color], limit * self.ticks_per_second
        )
        apart = {number: ticks / self.ticks_per_second for number, ticks in found.apart.items()}
        if depth and not found.place:
            nearest_one = min(apart.values(), default=math.inf)
            raise CaptureError(
                f"{where}: no depth image has a color image within {limit:g} s; the nearest is {nearest_one:.3g} s "
                f"off: {allow_more('max_time_apart', nearest_one)}, or leave out registered"
            )
        skipped = {
            _name(number): f"no color image within {limit:g} s, the nearest is {apart[number]:.3g} s off"
            for number in range(len(depth))
            if number not in found.place
        }
        return found.place, skipped


def _name(number: int) -> str:
    return f"{number:06d}"
