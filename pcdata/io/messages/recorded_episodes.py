"""The samples and the episodes of recordings, as they state them or else as they lie."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pcdata.errors import CaptureError
from pcdata.files.sample_names import in_order
from pcdata.io.messages.cloud_recording import CloudRecording
from pcdata.io.messages.joined_recording import JoinedRecording
from pcdata.structures import Episode
from pcdata.structures.episodes import checked_episodes


def sample_ids(recordings: Mapping[str, JoinedRecording | CloudRecording]) -> list[list[str]]:
    """Return the ids of all images of each recording: as they state them, else numbers; of several with their names."""
    stated = [one.said.samples or [] for one in recordings.values()]
    together = [name for names in stated for name in names]
    fits = all(len(names) == len(one.times) for names, one in zip(stated, recordings.values()))
    if fits and len(set(together)) == len(together) and in_order(together) == together:
        return stated
    numbers = [[f"{number:06d}" for number in range(len(one.times))] for one in recordings.values()]
    return [[f"{name}/{one}" if name else one for one in own] for name, own in zip(recordings, numbers)]


def recorded_episodes(recording: JoinedRecording | CloudRecording, name: str) -> list[Episode]:
    """Return the episodes that a recording states, else the whole of it as one of the name.

    Raises:
        CaptureError: what it states are no episodes of its images.
    """
    times = recording.times

    def episode(name: str, first: int, length: int, attributes: Mapping[str, Any]) -> Episode:
        inside = times[first : first + length]
        start = int(inside[0]) if len(inside) else 0
        seconds = [(int(time) - start) / 1e9 for time in inside] if len(inside) == length else []
        return Episode(name, first, length, seconds, {**attributes, "start_ns": start})

    if recording.said.episodes is None:
        return [episode(name, 0, len(times), {})]
    found = []
    for said in recording.said.episodes:
        if not {"id", "first", "length"} <= set(said) <= {"id", "first", "length", "attributes"}:
            raise CaptureError(f"{recording.where}: topic /pcdata: an episode must have id, first and length")
        bare = Episode(said["id"], said["first"], said["length"], attributes=said.get("attributes", {}))
        found.append(episode(bare.id, bare.first, bare.length, bare.attributes))
    return checked_episodes(f"{recording.where}: topic /pcdata", found, len(times))


def stated_episodes(whole: list[tuple[str, int, list[Episode]]]) -> list[Episode]:
    """Return the episodes of all recordings under their own names, which parts of one whole share across files."""
    found, before = [], 0
    for _, count, episodes in whole:
        found += [replace(one, first=before + one.first) for one in episodes]
        before += count
    return found


def renamed(episode: Episode) -> Episode:
    """Return an episode NAME/NAME as NAME: the only one of its file."""
    start, _, end = episode.id.partition("/")
    return replace(episode, id=start) if start == end else episode
