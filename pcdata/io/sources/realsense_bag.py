"""Recordings of a RealSense: ``.bag`` files as its viewer and SDK write them.

Source: librealsense, third-party/realsense-file/rosbag: topics ``/device_D/sensor_S/STREAM_I/...``; depth units are an
option of the depth sensor. The transform of the color stream is taken as color from depth; of the four readings
(either direction, rotation transposed, none) it is the one that lays depth edges on color edges.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError, IntrinsicsError, PcdataError, UnitError
from pcdata.extras import require
from pcdata.files.library_errors import name_file
from pcdata.files.opening import MAX_STREAMED_BYTES, existing_file
from pcdata.geometry import rigid
from pcdata.io.calibration.stated_lens import lens_of
from pcdata.io.messages.bag_file import BagFile, bag_topics
from pcdata.io.messages.decoding import decoded
from pcdata.io.messages.images import color_pixels, depth_numbers
from pcdata.io.messages.message_log import MessageLog
from pcdata.io.sources.recording import READ_COLOR, Recorded, RecordingSource, Taken
from pcdata.io.sources.registry import register_layout
from pcdata.structures import Camera

_DATA = re.compile(r".*/(?P<kind>[^/]+?)(_\d+)?/(image|imu|points|pose|transform)/data")
_IMAGES = re.compile(r"(?P<sensor>/device_\d+/sensor_\d+)/(?P<kind>Depth|Color)_\d+/image/data")
_DEVICE = re.compile(r"/device_\d+/")


def is_realsense(path: Path) -> bool:
    """Say whether a file is the recording of a RealSense's viewer or SDK: its topics are called as no robot's are."""
    return _RealSenseBagSource._is_recording(path)


class _Bag:
    """The messages of a bag; times are nanoseconds on the recorder's clock."""

    def __init__(self, log: MessageLog) -> None:
        self.log = log

    @property
    def topics(self) -> list[str]:
        """The names of all topics, sorted."""
        return list(self.log.topics)

    def times(self, topic: str) -> list[int]:
        """Return when each message of a topic was recorded, in order."""
        return self.log.topics[topic].times.tolist() if topic in self.log.topics else []

    def message(self, topic: str, number: int = 0) -> Any:
        """Return one message of a topic, counted in the order of time."""
        if topic not in self.log.topics:
            raise CaptureError(f"topic {topic} has 0 messages, there is no number {number}")
        with self.log.opened() as read:
            return decoded(self.log.topics[topic], read(self.log.topics[topic], number))


@dataclass(frozen=True, eq=False)
class _Stream:
    topic: str  # of the images
    camera: Camera
    pose: Tensor  # (4, 4) float64: this stream from the reference stream


@register_layout
class _RealSenseBagSource(RecordingSource):
    """The recording of one RealSense; times are those of recording, in nanoseconds."""

    kind = "realsense_bag"
    needs = "a ROS 1 .bag that a RealSense recorded, or a folder with one; reading it needs rosbags"
    suffix = ".bag"
    role = "bag"
    ticks_per_second = 1e9

    @classmethod
    def _begins_so(cls, stream: BinaryIO) -> bool:
        topics = bag_topics(stream, os.fstat(stream.fileno()).st_size)
        return any(_DEVICE.match(topic) for topic in topics)

    def _open(self, where: str, path: Path, registered: bool) -> Recorded:
        require("rosbags")
        if not self._is_recording(path):
            existing_file(where, path, max_bytes=MAX_STREAMED_BYTES)  # one that is empty says so
            raise CaptureError(f"{where}: is no bag of a RealSense; this layout needs {self.needs}")
        with _said_of(where):
            bag = _Bag(MessageLog([BagFile(path)]))
            self._depth = _one_stream(bag, "Depth")
            self._color = _one_stream(bag, "Color") if registered else None
            sensor = self._depth.topic.rsplit("/", 3)[0]
            read = [stream.topic for stream in (self._depth, self._color) if stream]
            self._bag = _Bag(bag.log.only(read))
            return Recorded(
                depth_times=bag.times(self._depth.topic),
                color_times=bag.times(self._color.topic) if self._color else [],
                metres_per_unit=_unit(where, bag, sensor),
                sensor=_device(bag, sensor.rsplit("/", 1)[0]),
                unread=[*bag.log.damage, *_unread(bag, set(read))],
            )

    def _take(self, depth: int, color: int | None) -> Taken:
        colors = None
        with _said_of(str(self)):
            units = depth_numbers(self._bag.message(self._depth.topic, depth))
            if units.dtype != np.uint16:
                raise CaptureError("depth must be encoded as 16UC1 or mono16, not 32FC1")
            if self._color is not None and color is not None:
                color_from_depth = self._color.pose @ rigid.invert_rigid(self._depth.pose)
                colors = color_pixels(self._bag.message(self._color.topic, color)), self._color.camera, color_from_depth
        return Taken(units, self._depth.camera, colors)


@contextmanager
def _said_of(where: str) -> Iterator[None]:
    try:
        yield
    except PcdataError as error:
        name_file(error, where, where)
        raise


def _unread(bag: _Bag, read: set[str]) -> list[str]:
    """Say which streams a recording has besides those that are read; settings and infos of streams are not told."""
    told = []
    for topic in bag.topics:
        match = _DATA.fullmatch(topic)
        if match and topic not in read:
            use = f"; {READ_COLOR}" if match["kind"] == "Color" else ""
            name = {"Color": "color"}.get(match["kind"], match["kind"])
            told.append(f"{name} stream {topic} ({len(bag.times(topic))} messages){use}")
    return told


def _one_stream(bag: _Bag, kind: str) -> _Stream:
    found = [topic for topic in bag.topics if (match := _IMAGES.fullmatch(topic)) and match["kind"] == kind]
    if len(found) != 1:
        some = ", ".join(found or bag.topics[:8]) or "none"
        raise CaptureError(f"needs one {kind} stream, found {len(found)}; topics: {some}")
    stream = found[0].removesuffix("/image/data")
    pose = bag.message(f"{stream}/tf/0")
    turn = [getattr(pose.rotation, axis) for axis in "xyzw"]
    shift = [getattr(pose.translation, axis) for axis in "xyz"]
    matrix = rigid.from_rotation_translation(
        rigid.rotation_from_quaternion(torch.tensor(turn, dtype=torch.float64, device="cpu")),
        torch.tensor(shift, dtype=torch.float64, device="cpu"),
    )
    return _Stream(found[0], _camera(kind, bag.message(f"{stream}/info/camera_info")), matrix)


def _camera(kind: str, info: Any) -> Camera:
    fx, skew, cx, _, fy, cy, *_ = (float(value) for value in info.K)
    lens = lens_of(f"the {kind} camera", str(info.distortion_model), info.D)
    if skew != 0:
        raise IntrinsicsError(f"the {kind} camera has skew {skew}; undistort the recording first")
    try:
        return Camera.pinhole(fx=fx, fy=fy, cx=cx, cy=cy, size=(int(info.height), int(info.width)), distortion=lens)
    except PcdataError as error:
        raise IntrinsicsError(f"the {kind} camera: {error}") from error


def _unit(where: str, bag: _Bag, sensor: str) -> float:
    topic = f"{sensor}/option/Depth Units/value"
    if topic not in bag.topics:
        raise UnitError(f"{where}: the recording does not state its depth unit; there is no topic {topic}")
    stored = np.float32(bag.message(topic).data)
    return check_metres_per_unit(where, float(str(stored)))  # 0.001 is stored as the float32 nearest to it


def _device(bag: _Bag, device: str) -> dict[str, str]:
    """Return name and serial number where they are stated."""
    topic = f"{device}/info"
    facts = [bag.message(topic, number) for number in range(len(bag.times(topic)))]
    wanted = {"Name": "sensor_name", "Serial Number": "serial"}
    return {wanted[fact.key]: str(fact.value) for fact in facts if fact.key in wanted}
