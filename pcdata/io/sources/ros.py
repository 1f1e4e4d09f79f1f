"""Recordings of robots: ROS 1 bags, ROS 2 bags (.db3, .mcap) and other MCAP files, read without ROS."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError, ConfigError, PcdataError
from pcdata.files.opening import check_inside
from pcdata.files.sample_names import check_known, in_order, name_some
from pcdata.io.calibration.foreign_cameras import check_motion
from pcdata.io.messages.camera_streams import Choice
from pcdata.io.messages.clock import CLOCKS, Clock
from pcdata.io.messages.cloud_recording import CloudRecording, cloud_topics
from pcdata.io.messages.image_topics import image_topics, told
from pcdata.io.messages.joined_recording import JoinedRecording
from pcdata.io.messages.joined_topics import Joining
from pcdata.io.messages.message_log import CONTAINERS, METADATA, MessageLog, container_of, opened_log
from pcdata.io.messages.recorded_episodes import recorded_episodes, renamed, sample_ids, stated_episodes
from pcdata.io.sources.listing import LinkTargets, absolute, entries, is_file, is_folder, link_targets
from pcdata.io.sources.option_checks import (
    check_invalid_values,
    check_name,
    check_pinhole,
    check_seconds,
    check_switch,
)
from pcdata.io.sources.realsense_bag import is_realsense
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.source import Source
from pcdata.structures import DepthFrame, Episode, PointCloud, Signal
from pcdata.structures.episodes import checked_episodes, joined_episodes, kept_episodes

_Value = TypeVar("_Value")
_SUFFIXES = tuple(container.suffix for container in CONTAINERS)


@register_layout
class _RosSource(Source):
    """The depth images of one or more cameras with the color, poses and signals of their moment.

    The first camera is the clock. Color and other cameras are the images nearest in time, joints are interpolated,
    poses too (slerp), commands and texts are the last ones. A depth image that lacks a partner is left out: ``skipped``
    tells which and why, ``streams`` what was dropped, doubled and interpolated. Times are seconds since the first
    image; the episode's attribute ``start_ns`` is the time of that.
    """

    kind = "ros"
    is_one_recording = True
    needs = (
        "a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag (metadata.yaml), or a folder of such files, each an "
        "episode; with depth images and what describes their camera; reading it needs rosbags"
    )

    def __init__(
        self,
        path: Path,
        *,
        depth: str | Collection[str] | None = None,
        color: str | Collection[str] | None = None,
        camera_info: Mapping[str, str] | None = None,
        cloud: str | None = None,
        registered: bool = False,
        color_from_depth: Sequence[float] | None = None,
        metres_per_unit: float | Mapping[str, float] | None = None,
        invalid_values: Collection[int] = (),
        intrinsics: Sequence[float] | Mapping[str, Sequence[float]] | None = None,
        frame_id: str | None = None,
        poses: Mapping[str, str] | None = None,
        signals: Mapping[str, Any] | None = None,
        clock: Clock | None = None,
        max_time_apart: float = 0.034,
        max_gap: float = 0.1,
        links_to: LinkTargets = (),
    ) -> None:
        """Read the index of the recording, the first message of each topic of images, and the times.

        Args:
            path: the file or folder.
            depth: the topic of depth images, or several, whose images are views of one sample; None = the only one.
            color: the topic of color images, or one for each depth; None = that of the same pixels, () = none.
            camera_info: by the topic of images, the one that describes their camera; else ``camera_info`` beside them.
            cloud: the topic of clouds (PointCloud2) to be read instead of depth images; None = the only one, where
                there is no depth.
            registered: register depth to color images of another camera.
            color_from_depth: the depth-to-color matrix, 16 numbers row by row, where tf does not tell it.
            metres_per_unit: length of one stored unit, or of several topics of depth, by topic; None = that of the
                encoding: 16UC1 millimetres, 32FC1 metres.
            invalid_values: stored whole numbers besides 0 that mean "no reading".
            intrinsics: (fx, fy, cx, cy) in pixels, where no message describes the one camera; or by topic of images.
            frame_id: a frame of tf that poses shall lead to, such as "base_link"; None = no poses.
            poses: by the name of a signal, the frame of tf whose pose in ``frame_id`` it is.
            signals: by the name of a stream, its topic without the first slash: kind, and maybe frame, rule ("nearest",
                "linear", "slerp", "step") and max_gap; or None, to leave it out. Joints are read without being named.
            clock: "header", when a message was taken; or "recorded"; None = that of the headers, where those of all
                streams are of one clock that goes on, by the times of recording.
            max_time_apart: seconds between images of one sample; the default is one frame at 30 Hz.
            max_gap: seconds from a depth image to the farther of two messages that are interpolated.
            links_to: folders outside that links in the capture may lead to.

        Raises:
            CaptureError: no recording, damaged, without depth, or one of several topics would have to be guessed.
            ConfigError: an option is impossible, or names what is not there.
            UnitError, IntrinsicsError: the unit or the camera of an image is stated nowhere.
            FrameError: a signal is in a frame, and no ``frame_id`` is said.
            MissingExtraError: rosbags is not installed.
        """
        path = absolute(path)
        where = f"{self.kind} source {path}"
        self._invalid = check_invalid_values(where, invalid_values)
        choice = Choice(
            depth=_topics(where, "depth", depth) or (),
            color=_topics(where, "color", color),
            camera_info=_mapping(where, "camera_info", camera_info),
            registered=check_switch(where, "registered", registered),
            color_from_depth=None
            if color_from_depth is None
            else check_motion(where, "color_from_depth", color_from_depth),
            metres_per_unit=_by_topic(where, metres_per_unit, check_metres_per_unit),
            intrinsics=_by_topic(where, intrinsics, check_pinhole),
            clock=_clock(where, clock),
        )
        joining = Joining(
            frame_id=check_name(where, "frame_id", frame_id),
            poses=_mapping(where, "poses", poses) or {},
            signals=signals,
            max_time_apart=check_seconds(where, "max_time_apart", max_time_apart),
            max_gap=check_seconds(where, "max_gap", max_gap),
        )
        allowed = link_targets(links_to)
        self._recordings: dict[str, JoinedRecording | CloudRecording] = {}  # by what the ids begin with
        self._paths: dict[str, Path] = {}
        for name, part in _parts(where, path, allowed).items():
            at = f"{self.kind} source {part}"
            log = opened_log(at, part, allowed)
            topic = _cloud_topic(at, log, choice, check_name(where, "cloud", cloud))
            if topic is None:
                self._recordings[name] = JoinedRecording(at, log, choice, joining)
            else:
                self._recordings[name] = CloudRecording(at, log, topic, choice)
            self._paths[name] = part
        self._numbers: dict[str, tuple[str, int]] = {}
        skipped: dict[str, str] = {}
        whole: list[tuple[str, int, list[Episode]]] = []
        for (name, recording), ids in zip(self._recordings.items(), sample_ids(self._recordings)):
            for number, sample_id in enumerate(ids):
                if number in recording.skipped:
                    skipped[sample_id] = recording.skipped[number]
                else:
                    self._numbers[sample_id] = (name, number)
            whole.append((name, len(ids), recorded_episodes(recording, name or path.stem)))
        super().__init__(path, self._numbers, links_to)
        self._skipped = skipped
        self._whole = whole

    @property
    def streams(self) -> list[dict[str, Any]]:
        """What each stream holds and how it was joined, JSON-able.

        Each has topic, type, role, rule, rate_hz, messages, dropped, doubled, interpolated, missing, largest_gap_s; of
        several recordings also which.
        """
        several = len(self._recordings) > 1
        return [
            {**({"recording": name} if several else {}), **stream}
            for name, recording in self._recordings.items()
            for stream in recording.streams
        ]

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """A file that begins as a container of messages does and is no RealSense's, or a folder of such."""
        try:
            if is_folder(path):
                files = _files(path)
                return bool(files) and not any(is_realsense(file) for file in files)
            return container_of(path) is not None and not is_realsense(path)
        except CaptureError:
            return False

    @classmethod
    def glance(cls, path: Path) -> list[str]:
        """Name the topics of the recording; of several, those of the first."""
        where = f"{cls.kind} source {path}"
        try:
            parts = _parts(where, absolute(path), ())
            log = opened_log(where, next(iter(parts.values())))
        except PcdataError:
            return []
        first = [f"{len(parts)} recordings; the topics of {next(iter(parts))}:"] if len(parts) > 1 else []
        return [*first, *(told(topic) for topic in log.topics.values())]

    def files(self, sample_id: str) -> dict[str, Path]:
        """Return the file of messages, or the first of them, which hold every sample."""
        name, _ = self._numbers[sample_id]
        return {"messages": self._recordings[name].file}

    def signals(self, sample_id: str) -> Mapping[str, Signal]:
        """Read the signals of one sample alone.

        Raises:
            CaptureError: the sample is unknown, or a message cannot be read.
        """
        check_known(str(self), sample_id, self._known)
        name, number = self._numbers[sample_id]
        return self._recordings[name].signals_at(number)

    def unread(self) -> list[str]:
        """Name the topics that are not read, what was dropped of those that are, and what of a file is damaged."""
        several = len(self._recordings) > 1
        return [
            f"{name}: {line}" if several else line
            for name, recording in self._recordings.items()
            for line in recording.unread
        ]

    def _times(self) -> dict[str, float]:
        found = {}
        for sample_id in self._ids:
            name, number = self._numbers[sample_id]
            times = self._recordings[name].times
            found[sample_id] = (int(times[number]) - int(times[0])) / 1e9
        return found

    def _read_episodes(self) -> list[Episode]:
        if is_folder(self.path) and is_file(self.path / "episodes.json"):
            return super()._read_episodes()
        found = stated_episodes(self._whole)
        if len(self._recordings) > 1 and not self._states_episodes(found):
            found = [renamed(one) for one in joined_episodes(self._whole)]
        total = sum(count for _, count, _ in self._whole)
        starts, before = {}, 0
        for name, count, _ in self._whole:
            starts[name], before = before, before + count
        kept = sorted(starts[name] + number for name, number in self._numbers.values())
        return kept_episodes(checked_episodes(str(self), found, total), kept)

    def _states_episodes(self, found: list[Episode]) -> bool:
        """Whether every recording says what its episodes are called, each by a name of its own."""
        stated = all(one.said.episodes is not None for one in self._recordings.values())
        return stated and len({one.id for one in found}) == len(found)

    def _load(self, sample_id: str) -> DepthFrame | PointCloud:
        name, number = self._numbers[sample_id]
        return self._recordings[name].load(number, sample_id, self.provenance(sample_id), self._invalid)


def _parts(where: str, path: Path, allowed: tuple[Path, ...]) -> dict[str, Path]:
    """Return the recordings of a path by what their ids begin with: "" where there is one."""
    if not is_folder(path) or is_file(path / METADATA):
        return {"": path}
    files = _files(path)
    if not files:
        raise CaptureError(f"{where}: holds no recording; this layout needs {_RosSource.needs}")
    for file in files:
        check_inside(where, file, [path, *allowed])
    if len(files) == 1:
        return {"": files[0]}
    names = [file.stem for file in files]
    if len(set(names)) < len(names):
        raise CaptureError(f"{where}: holds {name_some(file.name for file in files)}; two are of one name")
    return {name: files[names.index(name)] for name in in_order(names)}


def _files(folder: Path) -> list[Path]:
    """Return the files of messages in a folder; of the folder of a ROS 2 bag those beside its metadata."""
    return [entry for entry in entries(folder) if entry.suffix.lower() in _SUFFIXES and container_of(entry) is not None]


def _cloud_topic(where: str, log: MessageLog, choice: Choice, named: str | None) -> str | None:
    """Return the topic of clouds that is meant; None = depth images are."""
    if named is not None and choice.depth:
        raise ConfigError(f"{where}: depth and cloud are both named; read one of them at a time")
    if named is not None or choice.depth:
        return named
    clouds = cloud_topics(log)
    if len(clouds) != 1 or any(image.form.role == "depth" for image in image_topics(log).values()):
        return None
    return clouds[0].name


def _topics(where: str, option: str, given: Any) -> tuple[str, ...] | None:
    if given is None:
        return None
    listed = [given] if isinstance(given, str) else given
    if not isinstance(listed, (list, tuple)) or not all(isinstance(one, str) and one for one in listed):
        raise ConfigError(f"{where}: {option} must be a topic, or a list of topics, got {given!r:.200}")
    if len(set(listed)) < len(listed) and option == "depth":
        raise ConfigError(f"{where}: {option} names a topic twice: {given!r:.200}")
    return tuple(listed)


def _mapping(where: str, option: str, given: Any) -> Mapping[str, str] | None:
    fits = given is None or (
        isinstance(given, Mapping) and all(isinstance(text, str) and text for pair in given.items() for text in pair)
    )
    if not fits:
        raise ConfigError(f"{where}: {option} must be a mapping of names to names, got {given!r:.200}")
    return given


def _by_topic(where: str, given: Any, check: Callable[[str, Any], _Value]) -> _Value | dict[str, _Value] | None:
    """Return what is said of one camera, or of several, by the topics of their images."""
    if isinstance(given, Mapping):
        return {str(topic): check(where, value) for topic, value in given.items()}
    return None if given is None else check(where, given)


def _clock(where: str, given: Any) -> Clock | None:
    if given is not None and given not in CLOCKS:
        raise ConfigError(f"{where}: clock must be one of {', '.join(CLOCKS)}, got {given!r:.100}")
    known: Clock | None = given
    return known
