"""When a message was taken: the time in its header, or that of its recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from pcdata.errors import CaptureError
from pcdata.io.messages.decoding import HEADED, decoded, plain_type, stamp, stamp_of
from pcdata.io.messages.log_file import Topic
from pcdata.io.messages.message_log import MessageLog

Clock = Literal["header", "recorded"]
CLOCKS = ("header", "recorded")
_START = 32  # bytes of a message that hold its time


def on_clock(log: MessageLog, topic: Topic, clock: Clock) -> Topic:
    """Return a topic with the times of its messages on a clock, in their order.

    Messages without a header, such as plain numbers and texts, have the time of recording alone.

    Raises:
        CaptureError: headers hold no time, or a message is damaged.
    """
    has_header = topic.type in HEADED or plain_type(topic.type).startswith("foxglove.")
    if clock == "recorded" or not has_header or not len(topic):
        return topic
    times = np.empty(len(topic), np.int64)
    with log.opened() as read:
        for number in range(len(topic)):
            time = stamp_of(topic, read(topic, number, _START))
            times[number] = stamp(decoded(topic, read(topic, number))) if time is None else time
    if not times.any():
        raise CaptureError(
            f"topic {topic.name}: the headers of its messages hold no time; clock='recorded' (--clock recorded) "
            "takes the times of recording"
        )
    order = np.argsort(times, kind="stable")
    return replace(topic, times=times[order], places=topic.places[order])
