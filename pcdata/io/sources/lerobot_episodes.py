"""The episodes of a LeRobot dataset: as its own facts tell of them where pcdata wrote it, else as its index does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pcdata.errors import CaptureError
from pcdata.io.sources.lerobot_facts import FACTS, DatasetFacts, SignalFacts
from pcdata.io.sources.lerobot_index import LeRobotIndex
from pcdata.structures import Episode


def episodes_of(
    where: str,
    index: LeRobotIndex,
    facts: DatasetFacts | None,
    signals: Mapping[str, SignalFacts],
    times: Sequence[Sequence[float]] | None,
) -> list[Episode]:
    """Return the episodes, one after another.

    Args:
        where: for messages.
        index: of the dataset.
        facts: its own, where pcdata wrote it.
        signals: by name, for what their numbers are called.
        times: the seconds of every step of each episode as they were recorded, where the dataset keeps them.

    Raises:
        CaptureError: the facts do not know an episode.
    """
    found, first = [], 0
    names = _column_names(index, signals)
    for place, one in enumerate(index.episodes):
        own = None
        if facts is not None:
            if one.number >= len(facts.episodes):
                raise CaptureError(f"{where}: {FACTS} does not know episode {one.number}")
            own = facts.episodes[one.number]
        if own is None:
            tasks = list(dict.fromkeys(one.tasks))
            attributes = {"tasks": tasks, "fps": index.fps, "episode_index": one.number}
            robot = index.info.get("robot_type")
            attributes |= {"robot_type": robot} if isinstance(robot, str) else {}
            attributes |= {"names": names} if names else {}
            found.append(Episode(f"episode_{one.number:06d}", first, one.length, one.seconds, attributes))
        elif own.is_episode:
            seconds = times[place] if times is not None else ()
            found.append(Episode(own.id, first, one.length, seconds, own.attributes))
        first += one.length
    return found


def _column_names(index: LeRobotIndex, signals: Mapping[str, SignalFacts]) -> dict[str, Any]:
    """Return what the numbers of each signal are called, where the dataset says so."""
    columns = {name: one.column for name, one in signals.items() if one.column is not None}
    said = {name: index.features[column].get("names") for name, column in columns.items()}
    return {name: names for name, names in said.items() if isinstance(names, (list, dict)) and names}
