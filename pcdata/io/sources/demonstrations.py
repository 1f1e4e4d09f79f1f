"""Demonstrations in one HDF5 file: a group for each episode, in it an array for each stream with a row for each step.

A layout of this kind says which groups are episodes, what the arrays in one are, and how a view of a step is read; ids,
episodes, signals and the safety of reading are the same for all. The file is open only while something is read.

Source: HDF5 File Format Specification 3.0 (what is refused: see :mod:`pcdata.io.arrays.hdf5_arrays`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CaptureError, PcdataError
from pcdata.files.opening import MAX_STREAMED_BYTES, check_inside, open_input
from pcdata.files.sample_names import check_known, name_some, positions
from pcdata.io.arrays.hdf5_arrays import hard_linked
from pcdata.io.sources.demonstration_file import opened
from pcdata.io.sources.demonstration_steps import Demonstration, Steps, Stream
from pcdata.io.sources.joined_views import join_views
from pcdata.io.sources.listing import absolute, is_file, is_folder, visible_files
from pcdata.io.sources.source import Source
from pcdata.io.sources.stated_kinds import check_stated_names, kind_of, signal_of, stated_kinds
from pcdata.structures import DepthFrame, Episode, Signal

_MAGIC = b"\x89HDF\r\n\x1a\n"
_SUFFIXES = (".h5", ".hdf5")
_MAX_FILES = 100  # of a folder that are looked into


class DemonstrationSource(Source):
    """The steps of all episodes of a file, one after another; a sample is called ``EPISODE_STEP``."""

    def __init__(
        self,
        path: Path,
        demonstrations: Mapping[str, Demonstration],
        streams: Mapping[str, Stream],
        *,
        cameras: Sequence[str],
        signals: Mapping[str, Any] | None,
        frame_id: str,
        skipped: Mapping[str, str],
        unread: Sequence[str],
    ) -> None:
        """Take the list.

        Args:
            path: the file.
            demonstrations: by name.
            streams: the arrays that become signals, by the names of the signals.
            cameras: whose images are the views of a sample.
            signals: what is stated of the streams, see :func:`stated_kinds`.
            frame_id: where the poses of the cameras lead to.
            skipped: samples that were left out, and why.
            unread: what is not read although it could be, in words.

        Raises:
            CaptureError: there is no step, or names cannot be told apart.
            ConfigError: what is stated is no kind, or of a stream that is not there.
        """
        where = f"{self.kind} source {path}"
        texts = {name for one in demonstrations.values() for name in one.texts}
        stated = stated_kinds(where, signals)
        check_stated_names(where, stated, {*streams, *texts})
        kinds = {name: kind_of(name, stated, stream.kind) for name, stream in streams.items()}
        self._streams = {name: (streams[name].arrays, kind) for name, kind in kinds.items() if kind is not None}
        self._left_out = frozenset(name for name, kind in stated.items() if kind is None)
        self._demonstrations = dict(demonstrations)
        self._told = list(unread)
        self.cameras = list(cameras)
        self.frame_id = frame_id
        ids = [sample_name(name, step) for name, one in demonstrations.items() for step in range(one.length)]
        super().__init__(path, ids)
        self._skipped = dict(skipped)
        self._positions = positions(self._ids)

    @classmethod
    def file_of(cls, path: Path) -> Path:
        """Return the file that is given, or the only one of this layout in the folder that is given.

        Raises:
            CaptureError: there are several, or it is a link that leads out of the folder.
        """
        path = absolute(path)
        if not is_folder(path):
            return path
        where = f"{cls.kind} source {path}"
        found = cls._in_folder(path)
        if len(found) != 1:
            if not found:
                raise CaptureError(f"{where}: no such file; this layout needs {cls.needs}")
            names = name_some(file.name for file in found)
            raise CaptureError(f"{where}: holds {names}; give the path of one, or '{path}/*{found[0].suffix}' for all")
        check_inside(where, found[0], [path])
        return found[0]

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """An HDF5 file with such episodes, or a folder with one."""
        try:
            return bool(cls._in_folder(path)) if is_folder(path) else cls._is_recording(path)
        except CaptureError:
            return False

    @classmethod
    def _in_folder(cls, folder: Path) -> list[Path]:
        files = visible_files(folder, lambda name: Path(name).suffix.lower() in _SUFFIXES)
        return [file for file in files[:_MAX_FILES] if cls._is_recording(file)]

    @classmethod
    def _is_recording(cls, path: Path) -> bool:
        if not is_file(path) or path.suffix.lower() not in _SUFFIXES:
            return False
        try:
            with open_input("recognizes", path, max_bytes=MAX_STREAMED_BYTES) as stream:
                if stream.read(len(_MAGIC)) != _MAGIC:
                    return False
            with opened("recognizes", path) as file:
                return cls._is_such(file)
        except (PcdataError, OSError):
            return False

    @classmethod
    @abstractmethod
    def _is_such(cls, file: Any) -> bool:
        """Say whether an open file is of this layout."""

    @abstractmethod
    def _view(self, steps: Steps, camera: str, sample_id: str) -> DepthFrame:
        """Read the view of one camera."""

    def files(self, sample_id: str) -> dict[str, Path]:
        """Return the file, which holds every sample."""
        return {"recording": self.path}

    def unread(self) -> list[str]:
        """Name the arrays of the file that are not read."""
        return list(self._told)

    def signals(self, sample_id: str) -> Mapping[str, Signal]:
        """Read the signals of one step alone.

        Raises:
            CaptureError: the sample is unknown, or an array of it is damaged or not of its kind.
        """
        check_known(str(self), sample_id, self._known)
        with opened(str(self), self.path) as file:
            return self._signals(self._steps(file, sample_id))

    def _read_episodes(self) -> list[Episode]:
        found, places = [], {name: place for place, name in enumerate(self._ids)}
        for name, one in self._demonstrations.items():
            first = places[sample_name(name, 0)]
            if self._ids[first + one.length - 1] != sample_name(name, one.length - 1):
                raise CaptureError(f"{self}: the names of the episodes stand in no order; name them alike, as demo_0")
            times = [step * one.seconds for step in range(one.length)] if one.seconds else []
            found.append(Episode(name, first, one.length, times, one.attributes))
        return sorted(found, key=lambda episode: episode.first)

    def _load(self, sample_id: str) -> DepthFrame:
        with opened(str(self), self.path) as file:
            steps = self._steps(file, sample_id)
            frames = [self._view(steps, camera, sample_id) for camera in self.cameras]
            signals = self._signals(steps)
        facts = [frame.provenance for frame in frames]
        shared = {key: value for key, value in facts[0].items() if all(one.get(key) == value for one in facts)}
        if steps.seconds:
            shared["timestamps"] = [steps.step * steps.seconds]
        frame = join_views(frames, {**shared, "cameras": self.cameras})
        return replace(frame, recorded_signals=signals, capture_index=self._positions[sample_id])

    def _steps(self, file: Any, sample_id: str) -> Steps:
        name, _, step = sample_id.rpartition("_")
        one = self._demonstrations[name]
        group = hard_linked(file, one.group)
        if group is None:
            raise CaptureError(f"{self}: the group {one.group} is there no more")
        return Steps(f"{self.path}: {one.group}", group, int(step), self.path.stat().st_size, one)

    def _signals(self, steps: Steps) -> dict[str, Signal]:
        found: dict[str, Signal] = {}
        for name, (arrays, kind) in self._streams.items():
            rows = [steps.row(array) for array in arrays]
            values = rows[0] if len(rows) == 1 else np.concatenate(rows)
            found[name] = signal_of(f"{steps.where}: step {steps.step}", name, _tensor(values)[None], kind)
        for name, text in steps.demonstration.texts.items():
            if name not in self._left_out:
                found[name] = signal_of(steps.where, name, (text,), ("text", None))
        return found


def sample_name(name: str, step: int) -> str:
    """Return the id of a step of an episode."""
    return f"{name}_{step:06d}"


def _tensor(values: NDArray[Any]) -> Tensor:
    """Return numbers as a tensor; whole numbers that no tensor of old versions has become wider ones."""
    wider = {"u2": np.int32, "u4": np.int64, "u8": np.int64}.get(values.dtype.str[1:])
    if values.dtype.str[1:] == "u8" and values.size and int(values.max()) > np.iinfo(np.int64).max:
        raise CaptureError(f"numbers up to {int(values.max())} are more than any tensor holds")
    native = values.astype(wider if wider is not None else values.dtype.newbyteorder("="))
    return torch.from_numpy(np.ascontiguousarray(native)) if native.ndim else torch.from_numpy(native.reshape(1))[0]
