"""What a writer of captures is: options as fields, one method that fills an empty folder, and what it tells of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from pcdata.errors import ConfigError, NoReadingError, PcdataError, add_note
from pcdata.files.inputs import recording
from pcdata.io.sources.capture_source import REFUSALS, checked_ids, episodes_of, inputs_of
from pcdata.progress import Progress
from pcdata.structures import DepthFrame, Episode

# What a capture may hold besides its depth and cameras, and how one that has it is told.
KEPT: dict[str, Callable[[DepthFrame], bool]] = {
    "color": lambda frame: frame.colors is not None,
    "labels": lambda frame: frame.labels is not None,
    "mask": lambda frame: frame.mask is not None,
    "confidence": lambda frame: frame.confidence is not None,
    "lens": lambda frame: frame.camera.distortion is not None,
    "pose": lambda frame: frame.world_from_camera is not None,
    "signals": lambda frame: bool(frame.recorded_signals),
    "sensor": lambda frame: any(frame.provenance.get(key) for key in ("sensor_name", "serial")),
}
_NO_STREAM = ("signals", "sensor")  # one is told by the names of the signals, the other is a remark


@dataclass
class _Loss:
    """Something of captures that does not come back as it was.

    Args:
        how: what became of it, in words.
        metres: the largest difference, of lengths.
        levels: the largest difference, of colors, in levels of 255.
        values: how many values changed by more than that, such as depth beyond the range.
        captures: how many captures lost some of it.
    """

    how: str
    metres: float = 0.0
    levels: int = 0
    values: int = 0
    captures: int = 0

    def __str__(self) -> str:
        largest = f"; by {1000 * self.metres:.6g} mm at most" if self.metres else ""
        beyond = f"; {self.values:,} values were beyond the range" if self.values else ""
        where = f" ({self.captures} captures)" if self.captures else ""
        levels = f"; by {self.levels} of 255 levels at most" if self.levels else ""
        return f"{self.how}{where}{largest}{levels}{beyond}"


@dataclass
class WrittenReport:
    """What was written.

    Args:
        folder: where.
        kind: the writer's name.
        samples: how many captures.
        episodes: how many episodes.
        size: bytes on disk.
        lost: what does not come back as it was, by name: depth, color, ...
        left_out: id of a capture that was left out -> why.
        not_read: what lies in the captures but is not read, so not written either.
        notes: what else to know.
        streams: what the captures hold: depth, color, ..., and signals by their names.
        looked_at: of a dry run, how many captures it is judged by; the size is theirs, times as many as there are.
    """

    folder: Path
    kind: str
    samples: int = 0
    episodes: int = 0
    size: int = 0
    lost: dict[str, _Loss] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    not_read: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    streams: list[str] = field(default_factory=list)
    looked_at: int | None = None


class Captures:
    """The captures that a writer gets, each read once and in order, and what it has to say of them."""

    def __init__(
        self, source: Any, keeps: Collection[str], report: WrittenReport, progress: Progress | None = None
    ) -> None:
        self.source = source
        self._left_behind = {name: has for name, has in KEPT.items() if name not in keeps}
        self.ids: list[str] = checked_ids("convert", source)
        self.episodes: list[Episode] = episodes_of(source)
        self.name = str(getattr(source, "name", "captures"))
        self._report, self._progress = report, progress
        self.latest = ""  # the capture that was loaded last
        self.inputs = inputs_of(source)

    def __len__(self) -> int:
        return len(self.ids)

    def __iter__(self) -> Iterator[tuple[str, DepthFrame]]:
        return self.read(self.ids)

    def read(self, ids: Sequence[str]) -> Iterator[tuple[str, DepthFrame]]:
        """Load captures one after another, on the CPU; an id and what it holds at a time.

        Raises:
            ConfigError: one is no depth image.
            NoReadingError: no pixel of one has a reading, which no layout could give back.
            PcdataError: one cannot be read.
        """
        for sample_id in ids:
            try:
                with recording(self.inputs):
                    frame = _depth_frame(self.source.load(sample_id))
            except PcdataError as error:
                out = f"; leave it out with --skip {sample_id}, or all such captures with --skip-refused"
                hint = out if isinstance(error, REFUSALS) else ""
                add_note(error, f"sample {sample_id!r} of {self.source!r}{hint}", sample_id=sample_id)
                raise
            self.inputs.check_latest("convert")
            self.latest = sample_id
            yield sample_id, frame
            self._report.samples += 1
            for stream in _streams(frame):
                if stream not in self._report.streams:
                    self._report.streams.append(stream)
            for name, has in self._left_behind.items():
                if has(frame):
                    self.lose(name, f"{self._report.kind} has no place for it", captures=1)
            if self._progress is not None:
                self._progress(self._report.samples, len(self.ids), sample_id)

    def times(self) -> dict[str, float]:
        """Return the seconds of every capture of an episode that knows them."""
        return {
            self.ids[place]: time for one in self.episodes if one.times for place, time in zip(one.steps, one.times)
        }

    def lose(
        self, what: str, how: str, *, metres: float = 0.0, levels: int = 0, values: int = 0, captures: int = 0
    ) -> None:
        """Tell that something does not come back as it was; of what is told again, the largest difference counts."""
        loss = self._report.lost.setdefault(what, _Loss(how))
        loss.metres, loss.levels = max(loss.metres, metres), max(loss.levels, levels)
        loss.values += values
        loss.captures += captures

    def note(self, text: str) -> None:
        """Tell something that is no loss, once."""
        if text not in self._report.notes:
            self._report.notes.append(text)


@dataclass(frozen=True, kw_only=True)
class Writer(ABC):
    """A layout that captures can be written in; the fields of a subclass are its options."""

    kind: ClassVar[str]
    layout: ClassVar[str]  # what is written, in words
    keeps: ClassVar[frozenset[str]]  # of KEPT, what comes back as it was; the rest is told as lost

    @abstractmethod
    def write(self, captures: Captures, folder: Path) -> None:
        """Write all captures into an empty folder, which gets its name when all of it is there.

        What does not come back as it was is told by :meth:`Captures.lose`.

        Raises:
            ConfigError: an option does not fit the captures.
            CaptureError: a capture does not fit the layout, or those before it.
        """


def _streams(frame: DepthFrame) -> list[str]:
    held = [name for name, has in KEPT.items() if has(frame) and name not in _NO_STREAM]
    return ["depth", *held, *(f"signal {name}" for name in frame.recorded_signals)]


def _depth_frame(data: Any) -> DepthFrame:
    if not isinstance(data, DepthFrame):
        raise ConfigError(
            f"convert: a capture is no depth image but a {type(data).__name__}, and depth images with their cameras "
            "are what is written: leave such captures out (--skip ID, or --only a pattern of the others); 'pcdata "
            "build' stores clouds, 'pcdata export' writes them for others"
        )
    frame = data.cpu()
    for view in range(frame.num_views):
        if not bool((frame.depth[view] > 0).any()):
            raise NoReadingError(f"no pixel of view {view} has a reading, so nobody could read it back")
    return frame
