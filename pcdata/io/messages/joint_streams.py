"""The joints of a robot: positions, velocities and efforts of those that are published together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from pcdata.io.messages.decoding import decoded
from pcdata.io.messages.log_file import Topic
from pcdata.io.messages.message_log import MessageLog
from pcdata.io.messages.signal_streams import SignalStream

_JOINT_FIELDS = ("position", "velocity", "effort")
_FIRST = 64  # messages that show whether joints are published together


def joint_streams(log: MessageLog, topic: Topic, max_gap: float) -> tuple[list[SignalStream], list[str]]:
    """Return positions, velocities and efforts of the joints of a topic, and in words what is left out.

    Joints that are published by several nodes, in messages of their own, are signals of their own.
    """
    streams: list[SignalStream] = []
    left: list[str] = []
    base = topic.name.strip("/")
    with log.opened() as read:
        groups = _groups(lambda number: decoded(topic, read(topic, number)), len(topic))
        for number, (joints, numbers) in enumerate(groups.items()):
            name = base if len(groups) == 1 else f"{base}/{number}"
            own = (
                topic if len(groups) == 1 else replace(topic, times=topic.times[numbers], places=topic.places[numbers])
            )
            first = decoded(own, read(own, 0))
            if len(set(joints)) < len(joints):
                twice = next(joint for joint in joints if joints.count(joint) > 1)
                left.append(f"{topic.name}: its messages name the joint {twice!r:.60} twice")
                continue
            for part in _JOINT_FIELDS:
                values = np.asarray(getattr(first, part))
                if len(values) < len(joints) or not joints:
                    continue
                if not np.isfinite(values).all():
                    left.append(f"{part} of {topic.name}: the first message has values that are not finite")
                    continue
                stream = SignalStream(f"{name}/{part}", own, "invariant", None, "linear", max_gap, part, tuple(joints))
                streams.append(stream)
    return streams, left


def _groups(message: Callable[[int], Any], count: int) -> dict[tuple[str, ...], list[int]]:
    """Return the messages by the joints they name, in the order of the first that names them so."""
    order: dict[frozenset[str], tuple[str, ...]] = {}
    found: dict[tuple[str, ...], list[int]] = {}
    for number in range(count):
        names = tuple(map(str, message(number).name))
        found.setdefault(order.setdefault(frozenset(names), names), []).append(number)
        if number + 1 == min(count, _FIRST) and len(found) == 1:
            return {names: [] for names in found}  # all together: the rest is held to it where it is read
    return found
