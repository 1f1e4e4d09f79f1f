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
LATE = 1.0  # seconds between header and recording that no transport takes
_FEW = 3  # messages of which nothing is said: one that is latched may be of any time before


def has_header(topic: Topic) -> bool:
    """Whether the messages of a topic say when they were taken."""
    return topic.type in HEADED or plain_type(topic.type).startswith("foxglove.")


def on_clock(
    log: MessageLog,
    topics: Iterable[Topic],
    clock: Clock | None,
    takers: Mapping[Topic, Callable[[int, Any], None]] | None = None,
) -> dict[Topic, Topic]:
    """Return topics with the times of their messages on a clock, in their order; the files are read through once.

    Messages without a header, such as plain numbers and texts, have the time of recording alone.

    Args:
        log: the recording.
        topics: of it, or parts of topics.
        clock: that is wanted; None = that of the headers, which must not be set back.
        takers: by topic, what takes each of its messages and their numbers in the same pass, in the order of the file.

    Raises:
        CaptureError: headers hold no time, all or some, their clock is set back, or a message is damaged.
    """
    found = {topic: topic for topic in topics}
    headed = [topic for topic in found if clock != "recorded" and has_header(topic) and len(topic)]
    times = {topic: np.empty(len(topic), np.int64) for topic in headed}
    takers = takers or {}
    with log.opened() as read:
        for topic, number in in_file_order([*headed, *takers]):
            if topic in times:
                time = stamp_of(topic, read(topic, number, _START))
                times[topic][number] = stamp(decoded(topic, read(topic, number))) if time is None else time
            if topic in takers:
                takers[topic](number, decoded(topic, read(topic, number)))
    timed = {topic: _timed(topic, own) for topic, own in times.items()}
    if clock is None:
        for topic, own in times.items():
            _check_goes_on(topic, own)
    return found | timed


def lateness(recorded: NDArray[np.int64], taken: NDArray[np.int64]) -> float | None:
    """Return by how many seconds messages were recorded after the times in their headers.

    None where that says nothing: of few messages, and where it differs so much that one of the two is no time.
    """
    late = (np.sort(recorded) - np.sort(taken)) / 1e9
    if len(late) < _FEW:
        return None
    low, middle, high = np.quantile(late, (0.1, 0.5, 0.9)).tolist()
    return float(middle) if high - low < LATE else None


def _check_goes_on(topic: Topic, times: NDArray[np.int64]) -> None:
    """Require that headers go on as messages were recorded: set back, a clock would lay one run into another."""
    recorded = times[np.argsort(topic.times, kind="stable")]
    back = np.maximum.accumulate(recorded) - recorded
    if len(back) and back.max() > LATE * 1e9:
        first = int((back > LATE * 1e9).argmax())
        raise CaptureError(
            f"topic {topic.name}: the headers go back by {back[first] / 1e9:.3g} s at message {first} of {len(times)}: "
            "the clock was set back, as by a simulator that begins anew; clock='recorded' (--clock recorded) takes the "
            "times of recording, or clock='header' (--clock header) the headers in their own order"
        )


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
