"""A recording of clouds: the messages of one topic of PointCloud2, each a sample."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pcdata.errors import CaptureError, ConfigError, near_matches
from pcdata.io.messages.camera_streams import Choice
from pcdata.io.messages.clock import on_clock
from pcdata.io.messages.decoding import decoded
from pcdata.io.messages.image_topics import told
from pcdata.io.messages.log_file import Topic
from pcdata.io.messages.message_log import MessageLog
from pcdata.io.messages.point_clouds import cloud_of
from pcdata.io.messages.statement import Statement
from pcdata.io.messages.transforms import plain_frame
from pcdata.structures import PointCloud, Signal

_CLOUD = "sensor_msgs/msg/PointCloud2"


def cloud_topics(log: MessageLog) -> list[Topic]:
    """Return the topics of clouds that have messages."""
    return [topic for topic in log.topics.values() if topic.type == _CLOUD and len(topic)]


class CloudRecording:
    """The clouds of one topic in the order of time, as they were recorded: in the frame of their header."""

    said = Statement()
    skipped: Mapping[int, str] = {}

    def __init__(self, where: str, log: MessageLog, name: str, choice: Choice) -> None:
        self.where, self.file = where, log.files[0].path
        if name not in log.topics:
            raise ConfigError(f"{where}: there is no topic {name!r:.200}{near_matches(name, log.topics)}")
        if log.topics[name] not in cloud_topics(log):
            raise CaptureError(f"{where}: topic {told(log.topics[name])} has no clouds (PointCloud2)")
        topic = log.topics[name]
        if isinstance(choice.metres_per_unit, Mapping):
            raise ConfigError(f"{where}: metres_per_unit of clouds must be one number, got {choice.metres_per_unit}")
        self._topic = on_clock(log, [topic], choice.clock)[topic]
        self._metres_per_unit = choice.metres_per_unit
        self.times = self._topic.times
        self.streams = [
            {
                "topic": name,
                "type": self._topic.type,
                "role": "cloud",
                "rule": "clock",
                "rate_hz": self._topic.rate(),
                "messages": len(self._topic),
                "largest_gap_s": 0.0,
            }
        ]
        self.unread = [
            *log.damage,
            *(told(topic) for topic in log.topics.values() if topic.name != name and len(topic)),
        ]
        self._log = log.only([name])

    def signals_at(self, number: int) -> dict[str, Signal]:
        """Return nothing: clouds are read alone."""
        return {}

    def load(self, number: int, sample_id: str, provenance: Mapping[str, Any], invalid: tuple[int, ...]) -> PointCloud:
        """Read a cloud.

        Raises:
            PcdataError: the message is damaged, or cannot be right.
        """
        with self._log.opened() as read:
            message = decoded(self._topic, read(self._topic, number))
        frame = plain_frame(message.header.frame_id) or "camera"
        at = f"{self.where}: {self._topic.name}, cloud {number}"
        cloud = cloud_of(at, message, frame_id=frame, metres_per_unit=self._metres_per_unit)
        time = int(self.times[number])
        facts = {
            **provenance,
            "metres_per_unit": self._metres_per_unit or 1.0,
            "timestamps": [(time - int(self.times[0])) / 1e9],
            "stamp_ns": time,
            "topics": {"cloud": self._topic.name},
        }
        return cloud.with_meta([{**cloud.meta[0], "sample_id": sample_id, "provenance": facts}])
