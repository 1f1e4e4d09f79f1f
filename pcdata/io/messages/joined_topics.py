"""The topics of a recording on the clock of its first depth camera: what belongs to each depth image, what has none."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pcdata.errors import CaptureError, FrameError, add_note
from pcdata.io.messages.camera_streams import (
    CameraStream,
    Choice,
    chosen_cameras,
)
from pcdata.io.messages.clock import LATE, Clock, has_header, lateness, on_clock
from pcdata.io.messages.decoding import decoded, plain_type
from pcdata.io.messages.image_topics import ImageTopic, image_topics, same_pixels, told
from pcdata.io.messages.log_file import Topic
from pcdata.io.messages.message_log import MessageLog
from pcdata.io.messages.signal_choice import chosen_signals
from pcdata.io.messages.signal_streams import SignalStream
from pcdata.io.messages.statement import TOPIC, Statement, read_statement
from pcdata.io.messages.transforms import FrameTree, TreeBuilder
from pcdata.io.sources.recording import READ_COLOR
from pcdata.io.sources.synchronized import Joined, allow_more, joined

_TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage", "foxglove.FrameTransform", "foxglove.FrameTransforms")
_STATIC = "tf_static"


@dataclass(frozen=True, kw_only=True)
class Joining:
    """How streams are joined.

    Args:
        frame_id: where poses lead to; None = that of the recording's own statement, or none.
        poses: names of signals, and the frames of tf whose poses they are.
        signals: what is said of streams by their names.
        max_time_apart: seconds between images.
        max_gap: seconds to the farther of two messages that are interpolated.
    """

    frame_id: str | None
    poses: Mapping[str, str]
    signals: Mapping[str, Any] | None
    max_time_apart: float
    max_gap: float


class JoinedTopics:
    """What of a recording belongs to each image of its first depth camera, counted from 0 in the order of time."""

    def __init__(self, where: str, log: MessageLog, choice: Choice, joining: Joining) -> None:
        """Find the streams and join them; no image but the first of each topic is read.

        Raises:
            CaptureError: the recording lacks something, or no depth image has all its partners.
            ConfigError: something that is not there was asked for.
            UnitError, IntrinsicsError, FrameError: what an image needs is stated nowhere, or cannot be right.
        """
        self._where = self.where = where
        self.file = log.files[0].path
        self._joining, self._color_from_depth = joining, choice.color_from_depth
        self.said = _statement(where, log)
        images = image_topics(log)
        self.cameras = chosen_cameras(where, log, images, self.said, choice)
        self.frame_id = joining.frame_id if joining.frame_id is not None else self.said.frame_id
        max_gap = joining.max_gap * 1e9
        self.signals, left = chosen_signals(where, log, self.said, joining.signals, max_gap)
        self._check_sizes()
        self._contradictions: list[str] = []
        self._tree = self._read_times(log, choice.clock)
        self.times = self.cameras[0].images.topic.times  # (N,) int64 nanoseconds
        self._check_clocks(log, choice.clock)
        self.skipped: dict[int, str] = {}
        self.streams: list[dict[str, Any]] = []
        self._joins: dict[str, Joined] = {}
        self._join()
        self._check_poses()
        if len(self.skipped) == len(self.times):
            raise CaptureError(
                f"{where}: no depth image of {len(self.times)} has all its partners: "
                f"{next(iter(self.skipped.values()))}; {self._way_out()}"
            )
        used = self._used()
        self.unread = [*log.damage, *self._contradictions, *left, *self._unread(log, images, used), *self._counted()]
        self._log = log.only(sorted(used))

    # -- what belongs together -----------------------------------------------------------------------------------------

    def _check_sizes(self) -> None:
        sizes = {camera.name: _seen_size(camera) for camera in self.cameras}
        if len(set(sizes.values())) > 1:
            named = ", ".join(f"{name} {size[1]}x{size[0]}" for name, size in sizes.items())
            raise CaptureError(
                f"{self._where}: views of one frame must have one size, but: {named}; read one camera at a time"
            )

    def _check_clocks(self, log: MessageLog, clock: Clock | None) -> None:
        """Require that all is on the clock of the depth, also what has no header and so the time of recording."""
        depth = self.cameras[0].images.topic
        if clock == "recorded" or not has_header(depth):
            return
        if clock is None:
            self._check_lateness(depth)
        bare = [one for one in self.signals if not has_header(one.topic)]
        if not bare:
            return
        apart = (float(np.median(log.topics[depth.name].times)) - float(np.median(self.times))) / 1e9
        if abs(apart) > LATE:
            raise CaptureError(
                f"{self._where}: messages of {bare[0].topic.name} have no header, so only the time of recording, and "
                f"the headers of {depth.name} are {abs(apart):.3g} s {'before' if apart > 0 else 'after'} that: two "
                f"clocks; clock='recorded' (--clock recorded) joins all by the times of recording, or {_left_out(bare)}"
            )

    def _check_lateness(self, depth: Topic) -> None:
        """Require that headers are as late as those of the depth are, by the recorder that saw both, and go on."""
        how = "clock='recorded' (--clock recorded) joins all by the times of recording"
        for one in (image for camera in self.cameras for image in (camera.images, camera.color) if image is not None):
            if len(one.topic) > 1 and one.topic.times[0] == one.topic.times[-1]:
                told = f"the headers of all {len(one.topic)} messages of {one.topic.name} hold one time"
                raise CaptureError(f"{self._where}: {told}; {how}")
        expected = self._late.get(depth.name)
        for name, late in self._late.items():
            if expected is not None and late is not None and abs(late - expected) > LATE:
                raise CaptureError(
                    f"{self._where}: the headers of {name} are {abs(late - expected):.3g} s "
                    f"{'behind' if late > expected else 'ahead of'} those of {depth.name}, by when both were recorded: "
                    f"two clocks; {how}; where they are right, and only come so late, clock='header' (--clock header) "
                    "takes them as they stand"
                )

    def _way_out(self) -> str:
        """Say what can be done where no depth image has all its partners."""
        worst = max(self.streams, key=lambda stream: int(stream.get("missing", 0)))
        signals = [one for one in self.signals if worst["role"] == f"signal {one.name}"]
        if signals:
            times = signals[0].topic.times
            early, late = int(self.times[0]) - int(times[-1]), int(times[0]) - int(self.times[-1])
            if max(early, late) > 0:
                where = (
                    f"end {early / 1e9:.3g} s before the first"
                    if early > 0
                    else f"begin {late / 1e9:.3g} s after the last"
                )
                return (
                    f"its times {where} depth image; if these are two clocks, clock='recorded' (--clock recorded) "
                    f"joins all by the times of recording; or {_left_out(signals)}"
                )
        leave = _left_out(signals) if signals else "leave the stream out"
        option = "max_time_apart" if worst["rule"] == "nearest" else "max_gap"
        nearest = float(self._joins[f"{worst['role']} {worst['topic']}"].gap.min(initial=math.inf)) / 1e9
        return f"{allow_more(option, nearest)}, or {leave}"

    def _join(self) -> None:
        limit = self._joining.max_time_apart * 1e9
        for number, camera in enumerate(self.cameras):
            if number:
                self._add("depth", camera.images.topic, "nearest", limit)
            else:
                count = len(self.times)
                self.streams.append(_stream("depth", camera.images.topic, "clock", {"messages": count}, 0.0))
            if camera.color is not None:
                self._add("color", camera.color.topic, "nearest", limit)
            for role, topic in camera.others.items():
                self._add(role, topic, "nearest", limit)
            if (poses := self._stated_pose(camera)) is not None:
                self._add("pose", poses, "step", math.inf)
        for signal in self.signals:
            self._add(f"signal {signal.name}", signal.topic, signal.rule, signal.max_gap)

    def _add(self, role: str, topic: Topic, rule: Any, limit: float) -> None:
        found = joined(self.times, topic.times, rule, limit)
        key = f"{role} {topic.name}"
        self._joins[key] = found
        reached = found.gap[found.found]
        largest = float(reached.max()) / 1e9 if len(reached) else 0.0
        self.streams.append(_stream(role, topic, rule, found.counts(), largest))
        what = {"depth": "depth image", "color": "color image"}.get(role, "value")
        within = "" if math.isinf(limit) else f" within {limit / 1e9:g} s"
        for number in np.flatnonzero(~found.found).tolist():
            gap = found.gap[number] / 1e9
            if rule == "step":
                reason = f"no {what} of {topic.name} at or before it{within}"
            elif math.isinf(gap):
                reason = f"no {what} of {topic.name} before and after it"
            else:
                which = "nearest" if rule == "nearest" else "farther of the two around it"
                reason = f"no {what} of {topic.name}{within}, the {which} is {gap:.3g} s off"
            self.skipped.setdefault(number, reason)

    def partner(self, role: str, topic: Topic, number: int) -> tuple[int, int, float]:
        """Return which messages of a joined topic belong to a depth image, and the share of the second."""
        found = self._joins[f"{role} {topic.name}"]
        return int(found.before[number]), int(found.after[number]), float(found.share[number])

    def _counted(self) -> list[str]:
        """Say in words what of the joined streams was dropped, and what lacked a partner."""
        lines = []
        for camera in self.cameras:
            topic = camera.images.topic
            if again := len(topic) - len(np.unique(topic.times)):
                lines.append(f"depth {topic.name}: {again} of {len(topic)} images have the time of another")
        for stream in self.streams[1:]:
            name = f"{stream['role']} {stream['topic']}"
            if stream["dropped"] and stream["rule"] == "nearest":  # of faster streams most are passed over
                lines.append(f"{name}: {stream['dropped']} of {stream['messages']} messages belong to no depth image")
            if stream["missing"]:
                lines.append(f"{name}: {stream['missing']} depth images have none")
        return lines

    # -- frames --------------------------------------------------------------------------------------------------------

    def _ways(self) -> list[tuple[str, str]]:
        """Return the pairs of frames between which poses are needed."""
        ways = []
        for camera in self.cameras:
            if self.frame_id is not None and self._stated_pose(camera) is None:
                ways.append((self.frame_id, camera.images.frame))
            if camera.color_camera is not None and camera.color is not None and self._color_from_depth is None:
                ways.append((camera.color.frame, camera.images.frame))
        ways += [(self.frame_id or "", frame) for frame in self._joining.poses.values()]
        ways += [
            (self.frame_id or "", one.frame) for one in self.signals if one.frame not in (None, self.frame_id, "camera")
        ]
        return [way for way in ways if way[0] != way[1]]

    def _stated_pose(self, camera: CameraStream) -> Topic | None:
        """Return the topic of the camera's poses, where the recording states those that are wanted."""
        return camera.poses if self.frame_id is not None and self.frame_id == self.said.frame_id else None

    def _read_times(self, log: MessageLog, clock: Clock | None) -> FrameTree | None:
        """Put all topics that are read on the clock, and return the tree of tf where it is needed: in one pass."""
        spatial = [one.name for one in self.signals if one.frame not in (None, "camera")]
        if self.frame_id is None and (spatial or self._joining.poses):
            name = next(iter(spatial or self._joining.poses))
            raise FrameError(
                f"{self._where}: the signal {name!r} is in a frame of its own; say frame_id=FRAME (--frame "
                "FRAME), where poses lead to"
            )
        ways = self._ways()
        unnamed = next((one.images.topic.name for one in self.cameras if not one.images.frame), None)
        if unnamed is not None and any(not frame for way in ways for frame in way):
            raise CaptureError(
                f"{self._where}: the headers of {unnamed} name no frame, so tf cannot tell where that camera is; leave "
                "out frame_id (--frame)"
            )
        builder = TreeBuilder(self._where)
        frames = [topic for topic in log.topics.values() if plain_type(topic.type) in _TF] if ways else []
        takers = {
            topic: builder.taker(
                static=topic.name.rpartition("/")[2] == _STATIC, recorded=topic.times, by_recorder=clock == "recorded"
            )
            for topic in frames
        }
        topics = [*(topic for one in self.cameras for topic in one.topics), *(one.topic for one in self.signals)]
        clocked = on_clock(log, topics, clock, takers)
        self._late = {one.name: lateness(one.times, clocked[one].times) for one in topics if has_header(one)}
        self.cameras = [one.on(clocked) for one in self.cameras]
        self.signals = [replace(one, topic=clocked[one.topic]) for one in self.signals]
        try:
            if not ways:
                return None
            tree = builder.tree().only(ways)
            self._contradictions = builder.contradictions(tree.edges)
            self._late |= builder.lateness(tree.edges)
            return tree
        except CaptureError as error:
            colors = [one.color.frame for one in self.cameras if one.color is not None and one.color_camera is not None]
            if any(way[0] in colors for way in ways) and not any(way[0] == self.frame_id for way in ways):
                add_note(
                    error,
                    "depth is registered to the color camera by the depth-to-color matrix, which tf lacks: give it as "
                    "color_from_depth (--color-from-depth '16 numbers')",
                )
            for one in self.signals:
                if one.frame not in (None, self.frame_id, "camera"):
                    add_note(
                        error, f"the signal {one.name!r} is said to be in {one.frame!r}, poses in {self.frame_id!r}"
                    )
            raise

    def _check_poses(self) -> None:
        """Leave out the depth images of whose time tf tells nothing."""
        if self._tree is None:
            return
        ways, gap = self._ways(), int(self._joining.max_gap * 1e9)
        for number, time in enumerate(self.times.tolist()):
            for target, source in ways if number not in self.skipped else ():
                if why := self._tree.why_none(target, source, time, gap):
                    self.skipped[number] = why
                    break
        self.streams += self._tree.streams(self.times, gap)

    def pose(self, target: str, source: str, time: int) -> Tensor:
        """Return (4, 4) float64 target_from_source at a time.

        Raises:
            CaptureError: tf tells none.
        """
        if target == source:
            return torch.eye(4, dtype=torch.float64, device="cpu")
        assert self._tree is not None
        return self._tree.pose(target, source, time, int(self._joining.max_gap * 1e9))

    # -- what is read --------------------------------------------------------------------------------------------------

    def _used(self) -> set[str]:
        used = {TOPIC}
        for camera in self.cameras:
            color = camera.color.topic if camera.color else None
            parts = (camera.images.topic, camera.infos, color, camera.poses, *camera.others.values())
            used |= {topic.name for topic in parts if topic is not None}
        return used | {one.topic.name for one in self.signals}

    def _unread(self, log: MessageLog, images: Mapping[str, ImageTopic], used: set[str]) -> list[str]:
        lines = []
        for topic in log.topics.values():
            kind = plain_type(topic.type)
            if topic.name in used or not len(topic) or kind.endswith(("/CameraInfo", ".CameraCalibration")):
                continue
            if kind in _TF:
                if self._tree is None and not any(map(self._stated_pose, self.cameras)):
                    lines.append(f"{told(topic)}; frame_id=FRAME (--frame FRAME) gives poses of it")
                continue
            use = ""
            if topic.name in images and images[topic.name].form.role == "color":
                has_color = any(camera.color is not None for camera in self.cameras)
                same = any(same_pixels(images[topic.name], camera.images) for camera in self.cameras)
                use = "; not all cameras that are read have color of their pixels, and views have it all or none"
                if has_color or not same:
                    use = f"; color={topic.name} reads it" if has_color else f"; color of other pixels: {READ_COLOR}"
            lines.append(told(topic) + use)
        return lines


def _seen_size(camera: CameraStream) -> tuple[int, int]:
    return camera.images.form.size if camera.color_camera is None else camera.color_camera.size


def _stream(role: str, topic: Topic, rule: str, counts: Mapping[str, int], largest_gap: float) -> dict[str, Any]:
    return {
        "topic": topic.name,
        "type": topic.type,
        "role": role,
        "rule": rule,
        "rate_hz": topic.rate(),
        **counts,
        "largest_gap_s": largest_gap,
    }


def _statement(where: str, log: MessageLog) -> Statement:
    topic = log.topics.get(TOPIC)
    if topic is None or topic.type != "std_msgs/msg/String" or not len(topic):
        return Statement()
    with log.opened() as read:
        return read_statement(where, str(decoded(topic, read(topic, len(topic) - 1)).data))


def _left_out(signals: Sequence[SignalStream]) -> str:
    name = signals[0].name
    return f"leave it out by signals={{{name!r}: None}} (--signal '{name}=')"
