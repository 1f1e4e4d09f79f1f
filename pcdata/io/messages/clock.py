"""When messages were taken: the times in their headers, or those of their recording."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError
from pcdata.io.messages.decoding import HEADED, decoded, plain_type, stamp, stamp_of
from pcdata.io.messages.log_file import Topic
from pcdata.io.messages.message_log import MessageLog, in_file_order

Clock = Literal["header", "recorded"]
CLOCKS = ("header", "recorded")
_LONGEST_RUN = 10**15  # nanoseconds, eleven days: later stamps are of a clock that counts from 1970
_START = 32  # bytes of a message that hold its time


def has_header(topic: Topic) -> bool:
    """Whether the messages of a topic say when they were taken."""
    return topic.type in HEADED or plain_type(topic.type).startswith("foxglove.")


def on_clock(
    log: MessageLog,
    topics: Iterable[Topic],
    clock: Clock,
    takers: Mapping[Topic, Callable[[int, Any], None]] | None = None,
) -> dict[Topic, Topic]:
    """Return topics with the times of their messages on a clock, in their order; the files are read through once.

    Messages without a header, such as plain numbers and texts, have the time of recording alone.

    Args:
        log: the recording.
        topics: of it, or parts of topics.
        clock: that is wanted.
        takers: by topic, what takes each of its messages and their numbers in the same pass, in the order of the file.

    Raises:
        CaptureError: headers hold no time, all or some, or a message is damaged.
    """
    found = {topic: topic for topic in topics}
    headed = [topic for topic in found if clock == "header" and has_header(topic) and len(topic)]
    times = {topic: np.empty(len(topic), np.int64) for topic in headed}
    takers = takers or {}
    with log.opened() as read:
        for topic, number in in_file_order([*headed, *takers]):
            if topic in times:
                time = stamp_of(topic, read(topic, number, _START))
                times[topic][number] = stamp(decoded(topic, read(topic, number))) if time is None else time
            if topic in takers:
                takers[topic](number, decoded(topic, read(topic, number)))
    return found | {topic: _timed(topic, own) for topic, own in times.items()}


def _timed(topic: Topic, times: NDArray[np.int64]) -> Topic:
    unset = int((times == 0).sum())
    if unset == len(times) or (unset and not _begins_at_zero(times)):
        which = "its messages" if unset == len(times) else f"{unset} of its {len(times)} messages"
        raise CaptureError(
            f"topic {topic.name}: the headers of {which} hold no time; clock='recorded' (--clock recorded) "
            "takes the times of recording"
        )
    order = np.argsort(times, kind="stable")
    return replace(topic, times=times[order], places=topic.places[order])


def _begins_at_zero(times: NDArray[np.int64]) -> bool:
    """Whether stamps of 0 may be times: the first ones of a simulator's clock."""
    first = int(np.flatnonzero(times)[0])
    return bool((times[first:] != 0).all()) and int(times.max()) < _LONGEST_RUN
