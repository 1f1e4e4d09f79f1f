"""Captures as ROS 2 recordings in MCAP: what any ROS tool shows, and beside it what only pcdata knows.

Depth is ``16UC1`` millimetres where that loses nothing, else ``32FC1`` metres with NaN for "no reading", as ROS tools
expect both (REP 118); so nobody has to know a unit. What ROS has no message for is in ``/pcdata``, see docs/convert.md.
"""

from __future__ import annotations

import importlib
import json
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from torch import Tensor

from pcdata.errors import CaptureError, ConfigError
from pcdata.geometry.rotations import nearest_sign, quaternion_from_rotation
from pcdata.io.images.writing import packed_color
from pcdata.io.writers.file_names import file_names
from pcdata.io.writers.registry import register_writer
from pcdata.io.writers.ros_messages import RosMessages, exact_as_doubles
from pcdata.io.writers.view_folder import whole_units
from pcdata.io.writers.writer import KEPT, Captures, Writer
from pcdata.structures import DepthFrame, Episode, Signal

SCHEMA = 1  # of the JSON in /pcdata
START = "start_ns"  # the attribute of an episode: when its first step was, nanoseconds since 1970
_IMAGES = ("colors", "labels", "mask", "confidence")
_NO_CLOCK = 10**9  # nanoseconds: where nobody knows when; 0 would mean "no time" to ROS
_MILLIMETRES = 0.001


@register_writer
@dataclass(frozen=True, kw_only=True)
class _McapWriter(Writer):
    """A ROS 2 recording of each episode, and of what lies between them.

    Args:
        color: "raw" and "png" lose nothing; "jpeg" is small.
        quality: of JPEG, 1 .. 95.
        compression: of the file: "zstd" or "none".
        fps: captures in a second, where no times are known of them; 10 otherwise.
    """

    kind: ClassVar[str] = "mcap"
    layout: ClassVar[str] = "EPISODE.mcap, a ROS 2 recording of each episode (ros2 bag, Foxglove, RViz)"
    keeps: ClassVar[frozenset[str]] = frozenset(KEPT) - {"sensor"}

    color: Literal["raw", "png", "jpeg"] = "raw"
    quality: int = 90
    compression: Literal["zstd", "none"] = "zstd"
    fps: float = 10.0

    def __post_init__(self) -> None:
        fps: Any = self.fps
        if isinstance(fps, bool) or not (isinstance(fps, (int, float)) and 0 < fps <= 1000):
            raise ConfigError(f"mcap: fps must be captures in a second, up to 1000, got {fps!r:.60}")
        for name, values in (("color", ("raw", "png", "jpeg")), ("compression", ("zstd", "none"))):
            if getattr(self, name) not in values:
                raise ConfigError(f"mcap: {name} must be one of {', '.join(values)}, got {getattr(self, name)!r:.80}")
        if isinstance(self.quality, bool) or not isinstance(self.quality, int) or not 1 <= self.quality <= 95:
            raise ConfigError(f"mcap: quality must be a whole number in 1 .. 95, got {self.quality!r:.80}")

    def write(self, captures: Captures, folder: Path) -> None:
        """Write a recording of each episode, and of what lies between them."""
        messages = RosMessages()
        parts = _parts(captures)
        for name, (ids, episode) in zip(file_names([name for name, _, _ in parts]), ((b, c) for _, b, c in parts)):
            with _opened(folder, name, self.compression) as bag:
                recording = _Recording(self, bag, messages, captures, ids, episode)
                for (_, frame), stamp in zip(captures.read(ids), _stamps(captures, ids, episode, self.fps)):
                    recording.add(frame, stamp)


def _parts(captures: Captures) -> list[tuple[str, list[str], Episode | None]]:
    """Return the recordings to make: name, ids, and the episode that it is."""
    parts: list[tuple[str, list[str], Episode | None]] = []
    end = 0
    places = [(one.first, one.first + one.length, one) for one in captures.episodes]
    for first, stop, episode in [*places, (len(captures), len(captures), None)]:
        if first > end:
            name = captures.name if not captures.episodes else f"no episode {captures.ids[end]}"
            parts.append((name or "captures", captures.ids[end:first], None))
        if episode is not None:
            parts.append((episode.id, captures.ids[first:stop], episode))
        end = stop
    return parts


def _stamps(captures: Captures, ids: Sequence[str], episode: Episode | None, fps: float) -> list[int]:
    """Return the nanoseconds of each capture, each later than the one before."""
    times = episode.times if episode is not None else ()
    start = episode.attributes.get(START) if episode is not None else None
    if not times and len(ids) > 1:
        captures.note(
            f"no times are known of some captures: they are {1 / fps:g} s apart in the recording (--set fps=N, "
            "captures in a second, says another)"
        )
    times = times or [place / fps for place in range(len(ids))]
    start = start if isinstance(start, int) and 0 < start < 1 << 62 else _NO_CLOCK
    stamps: list[int] = []
    for time in times:
        stamp = start + round((time - times[0]) * 1e9)
        stamps.append(max(stamp, stamps[-1] + 1) if stamps else stamp)
    return stamps


class _Recording:
    """One bag: makes topics when they are first needed, and says in ``/pcdata`` what they are."""

    def __init__(
        self, writer: _McapWriter, bag: Any, messages: RosMessages, captures: Captures, ids: list[str], episode: Any
    ) -> None:
        self.writer, self.bag, self.messages, self.captures = writer, bag, messages, captures
        self._topics: dict[str, Any] = {}
        self._views: list[str] = []
        self._turns: Tensor | None = None  # (V, 4) quaternions of the views in the capture before
        self._signals: dict[str, str] = {}  # what its topic is called, by name
        self._told = ""
        self._alike: tuple[tuple[int, int], set[str]] | None = None
        self._first = ""
        self._facts: dict[str, Any] = {"schema": SCHEMA, "cameras": {}, "signals": {}, "samples": ids}
        episodes = [] if episode is None else [{"id": episode.id, "first": 0, "length": episode.length}]
        self._facts["episodes"] = [{**one, "attributes": dict(episode.attributes)} for one in episodes]

    def add(self, frame: DepthFrame, stamp: int) -> None:
        """Write one capture."""
        if not self._views:
            names = _camera_names(frame)
            self._views = _ros_names(names, "camera")
            self._facts["cameras"] = {own: {"name": name} for name, own in zip(names, self._views)}
            self._facts |= {} if frame.frame_id is None else {"frame_id": frame.frame_id}
        if frame.num_views != len(self._views) or frame.frame_id != self._facts.get("frame_id"):
            raise CaptureError(
                f"{frame.sample_id}: has {frame.num_views} views with poses to {frame.frame_id!r}, but those before it "
                f"{len(self._views)} to {self._facts.get('frame_id')!r}; write these apart (--only, --skip)"
            )
        self._check_alike(frame)
        unit = frame.provenance.get("metres_per_unit")
        for own, about in zip(self._views, self._facts["cameras"].values()):
            about |= {
                "frame": _optical(own),
                "metres_per_unit": _MILLIMETRES,  # of images of whole numbers
                "recorded_metres_per_unit": unit if isinstance(unit, float) else None,  # that the capture came in
                "registered_to": "depth",  # what color and the other images are registered to
                "is_window": frame.camera.is_window,
            }
        self._add_signal_facts(frame)
        self._tell(stamp)
        for view, own in enumerate(self._views):
            self._add_view(frame.view(view) if frame.num_views > 1 else frame, own, stamp)
        if frame.world_from_camera is not None and frame.frame_id is not None:
            turns = quaternion_from_rotation(frame.world_from_camera[:, :3, :3])
            self._turns = turns if self._turns is None else nearest_sign(turns, self._turns)
            places = zip(map(_optical, self._views), frame.world_from_camera[:, :3, 3], self._turns)
            self._send("/tf", self.messages.transforms(stamp, frame.frame_id, [*places]), stamp)
        for name, signal in frame.recorded_signals.items():
            self._add_signal(name, signal, stamp)

    def _check_alike(self, frame: DepthFrame) -> None:
        """Require what the first capture has: a topic that pauses would be joined as a stream with a gap."""
        has = {role for role in (*_IMAGES, "world_from_camera") if getattr(frame, role) is not None}
        has |= {f"the signal {name!r}" for name in frame.recorded_signals}
        alike = (frame.size, has)
        if self._alike is None:
            self._alike, self._first = alike, frame.sample_id
        if self._alike != alike:
            size, others = self._alike
            what = f"{frame.size[1]}x{frame.size[0]} pixels, not {size[1]}x{size[0]}"
            if frame.size == size:
                what = f"{', '.join(sorted(has ^ others))} or not"
            raise CaptureError(
                f"{frame.sample_id}: has {what}, unlike {self._first}; all captures of a recording have the same: "
                "write these apart (--only, --skip)"
            )

    def _add_view(self, frame: DepthFrame, own: str, stamp: int) -> None:
        header = self.messages.header(stamp, _optical(own))
        info = self.messages.camera_info(header, frame.camera)
        metres = frame.depth[0].numpy()
        units = whole_units(metres, _MILLIMETRES)
        pixels = np.where(metres > 0, metres, np.float32(np.nan)) if units is None else units
        self._send(f"/{own}/depth/image_raw", self.messages.image(header, pixels), stamp)
        self._send(f"/{own}/depth/camera_info", info, stamp)
        if frame.colors is not None:
            self._add_color(own, header, frame.colors[0], stamp)
            self._send(f"/{own}/color/camera_info", info, stamp)
        for role, image, kind in (
            ("labels", frame.labels, np.int32),
            ("mask", frame.mask, np.uint8),
            ("confidence", frame.confidence, np.uint8),
        ):
            if image is not None:
                stored = _stored(frame, role, image[0], kind)
                self._send(f"/{own}/{role}/image_raw", self.messages.image(header, stored), stamp)
        if frame.world_from_camera is not None:  # tf has quaternions, which round the matrix
            self._send(f"/{own}/pose_matrix", self.messages.array(frame.world_from_camera[0].numpy()), stamp)

    def _add_color(self, own: str, header: Any, colors: Tensor, stamp: int) -> None:
        if self.writer.color == "raw":
            self._send(f"/{own}/color/image_raw", self.messages.image(header, colors.numpy()), stamp)
            return
        packed, apart = packed_color(colors, self.writer.color, self.writer.quality)
        if self.writer.color == "jpeg":
            self.captures.lose("color", f"JPEG of quality {self.writer.quality}", levels=apart, captures=1)
        message = self.messages.compressed(header, self.writer.color, packed)
        self._send(f"/{own}/color/image_raw/compressed", message, stamp)

    def _add_signal_facts(self, frame: DepthFrame) -> None:
        known = self._facts["signals"]
        for name, signal in frame.recorded_signals.items():
            if name not in self._signals:
                (self._signals[name],) = _ros_names([name], "signal", list(self._signals.values()))
            own = self._signals[name]
            dtype = str(signal.values.dtype).removeprefix("torch.") if isinstance(signal.values, Tensor) else "text"
            about = {"name": name, "kind": signal.kind, "frame": signal.frame}
            about |= {} if dtype == "text" else {"dtype": dtype}
            if known.setdefault(own, about) != about:
                raise CaptureError(
                    f"{frame.sample_id}: signal {name!r} is {about}, but before it was {known[own]}; a recording has "
                    "one kind, frame and type of each: write these apart (--only, --skip)"
                )

    def _add_signal(self, name: str, signal: Signal, stamp: int) -> None:
        topic = f"/signals/{self._signals[name]}"
        if not isinstance(signal.values, Tensor):
            self._send(topic, self.messages.text(signal.values[0]), stamp)
            return
        if not exact_as_doubles(signal.values):
            self.captures.lose("signals", f"{name}: whole numbers beyond 2^53 are rounded", captures=1)
        self._send(topic, self.messages.array(signal.values[0].double().numpy()), stamp)

    def _tell(self, stamp: int) -> None:
        """Write ``/pcdata``, and again when there is more to say: who reads later only, gets the last."""
        text = json.dumps(self._facts, ensure_ascii=False, allow_nan=False)
        if text != self._told:
            self._told = text
            self._send("/pcdata", self.messages.text(text), stamp, latched=True)

    def _send(self, topic: str, message: Any, stamp: int, *, latched: bool = False) -> None:
        if topic not in self._topics:
            self._topics[topic] = self.bag.add_connection(
                topic,
                message.__msgtype__,
                typestore=self.messages.types,
                offered_qos_profiles=[_latched_qos()] if latched else [],
            )
        self.bag.write(self._topics[topic], stamp, self.messages.pack(message))


@contextmanager
def _opened(folder: Path, name: str, compression: str) -> Iterator[Any]:
    """Open ``NAME.mcap`` to write; what rosbags writes beside it, ``metadata.yaml``, is in the file too."""
    rosbag2 = importlib.import_module("rosbags.rosbag2")
    bag = rosbag2.Writer(folder / name, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    if compression == "zstd":
        bag.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    with bag:
        yield bag
    os.replace(folder / name / f"{name}.mcap", folder / f"{name}.mcap")
    os.unlink(folder / name / "metadata.yaml")
    os.rmdir(folder / name)


def _latched_qos() -> Any:
    """Return the profile under which who listens later gets the last message too."""
    of = importlib.import_module("rosbags.interfaces")
    never = of.QosTime(2147483647, 4294967295)
    return of.Qos(
        of.QosHistory.KEEP_LAST, 1, of.QosReliability.RELIABLE, of.QosDurability.TRANSIENT_LOCAL, never, never,
        of.QosLiveliness.AUTOMATIC, never, False,
    )  # fmt: skip


def _camera_names(frame: DepthFrame) -> list[str]:
    told = frame.provenance.get("cameras")
    if isinstance(told, list) and len(told) == frame.num_views and len({*map(str, told)}) == len(told):
        return [*map(str, told)]
    return ["camera"] if frame.num_views == 1 else [f"view{v}" for v in range(frame.num_views)]


def _ros_names(names: Sequence[str], noun: str, taken: Sequence[str] = ()) -> list[str]:
    """Return names of which topics can be made, each another one: letters, digits and single underscores."""
    found: list[str] = [*taken]
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
        plain = plain if plain[:1].isalpha() else f"{noun}_{plain}".rstrip("_")
        unique, number = plain, 2
        while unique in found:
            unique, number = f"{plain}_{number}", number + 1
        found.append(unique)
    return found[len(taken) :]


def _optical(own: str) -> str:
    return f"{own}_optical_frame"


def _stored(frame: DepthFrame, role: str, image: Tensor, kind: Any) -> Any:
    values = image.numpy()
    if role == "labels" and len(values) and (values.max() >= 1 << 31 or values.min() < -(1 << 31)):
        raise CaptureError(
            f"{frame.sample_id}: labels reach {values.max()}, and ROS images hold 32 bits; renumber them"
        )
    return values.astype(kind) * (255 if role == "mask" else 1)
