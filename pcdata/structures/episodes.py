"""Episodes: which samples of a source were recorded one after another."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pcdata.errors import CaptureError, DTypeError, PcdataError

_LATEST = 1e15  # more seconds are nanoseconds, or damage
PART_OF = "part_of"  # the attribute of a part of an episode that lost steps: the id of the whole


@dataclass(frozen=True)
class Episode:
    """Samples that follow each other in time: one demonstration, one trial, one recording.

    Args:
        id: its name, unique among those of its source.
        first: the place of its first step among the ids of the source, from 0.
        length: its steps, 1 or more.
        times: seconds of every step, never falling; () = not known.
        attributes: JSON-able facts, such as the task, the operator, or whether it succeeded.

    Raises:
        CaptureError: no such name, place, length, times or attributes.
    """

    id: str
    first: int
    length: int
    times: Sequence[float] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (isinstance(self.id, str) and self.id and self.id.isprintable()):
            raise CaptureError(f"Episode: id must be a printable text that is not empty, got {self.id!r:.100}")
        where = f"episode {self.id!r:.100}"
        if not (_is_whole(self.first) and self.first >= 0 and _is_whole(self.length) and self.length >= 1):
            raise CaptureError(
                f"{where}: first must be a whole number from 0 and length one from 1, got {self.first!r:.100} and "
                f"{self.length!r:.100}"
            )
        given: Any = self.times  # whatever the annotation promises
        object.__setattr__(self, "first", int(self.first))
        object.__setattr__(self, "length", int(self.length))
        times: list[Any] = [*given] if isinstance(given, (list, tuple, np.ndarray)) else [None]
        if times and (len(times) != self.length or not all(map(_is_time, times))):
            raise CaptureError(
                f"{where}: times must be {self.length} finite seconds, one for each step, or (), got "
                f"{self.times!r:.100}"
            )
        if any(later < time for time, later in itertools.pairwise(times)):
            place = next(n for n in range(1, len(times)) if times[n] < times[n - 1])
            raise CaptureError(
                f"{where}: times must not fall, but step {place} is at {times[place]} s after {times[place - 1]} s; "
                "put the steps into the order of time, or make two episodes of them"
            )
        object.__setattr__(self, "times", tuple(map(float, times)))
        object.__setattr__(self, "attributes", _plain(where, self.attributes))

    @property
    def steps(self) -> range:
        """The places of its steps among the ids of the source."""
        return range(self.first, self.first + self.length)

    @property
    def whole(self) -> str:
        """The id of the recorded episode: its own, or of what it is a part of since steps were left out."""
        return str(self.attributes.get(PART_OF, self.id))


def checked_episodes(where: str, episodes: Iterable[Episode], num_samples: int) -> list[Episode]:
    """Return episodes that fit a list of samples: in order, one after another, each with a name of its own.

    Samples between, before and after them belong to no episode.

    Raises:
        DTypeError: one is no :class:`Episode`.
        CaptureError: two have one name, overlap or stand in another order, or one reaches beyond the samples.
    """
    if isinstance(episodes, Episode) or not isinstance(episodes, Iterable):
        raise DTypeError(f"{where}: episodes must be a list of pcdata.Episode, got {type(episodes).__name__}")
    episodes = list(episodes)
    end, seen = 0, set[str]()
    for episode in episodes:
        if not isinstance(episode, Episode):
            raise DTypeError(f"{where}: episodes must be pcdata.Episode, got {type(episode).__name__}")
        if episode.id in seen:
            raise CaptureError(f"{where}: two episodes are called {episode.id!r}; give each a name of its own")
        if episode.first < end:
            raise CaptureError(
                f"{where}: episode {episode.id!r} begins at sample {episode.first}, but the one before it ends at "
                f"{end}; episodes stand in the order of the samples and share none"
            )
        seen.add(episode.id)
        end = episode.first + episode.length
    if end > num_samples:
        raise CaptureError(
            f"{where}: episode {episodes[-1].id!r} ends at sample {end}, but there are {num_samples}; correct its "
            "first or its length"
        )
    return episodes


def kept_episodes(episodes: Sequence[Episode], places: Sequence[int]) -> list[Episode]:
    """Return the episodes of the samples that are kept, in their places among those.

    Where single steps are missing the rest is cut there: nothing goes on across a gap. The parts are called ``ID~0``,
    ``ID~1``, ... and say whose parts they are. Where samples are kept at one distance throughout (every second one,
    averages of ten) that distance is no gap.

    Args:
        episodes: in order.
        places: (K,) rising places of the kept samples before.
    """
    kept = np.asarray(places, dtype=np.int64)
    bounds = [np.searchsorted(kept, (one.first, one.first + one.length)) for one in episodes]
    distances = [np.diff(kept[low:high]) for low, high in bounds]
    usual = min((int(one.min()) for one in distances if len(one)), default=1)
    found = []
    for episode, (low, high), distance in zip(episodes, bounds, distances):
        edges = [int(low), *(int(low) + 1 + np.flatnonzero(distance > usual)).tolist(), int(high)]
        parts = [(start, stop) for start, stop in itertools.pairwise(edges) if stop > start]
        for number, (start, stop) in enumerate(parts):
            times = [episode.times[place - episode.first] for place in kept[start:stop]] if episode.times else ()
            part = replace(episode, first=start, length=stop - start, times=times)
            if len(parts) > 1:
                part = replace(
                    part, id=f"{episode.id}~{number}", attributes={**episode.attributes, PART_OF: episode.whole}
                )
            found.append(part)
    return found


def joined_episodes(parts: Iterable[tuple[str, int, Sequence[Episode]]]) -> list[Episode]:
    """Return the episodes of sources in a row: of each its name, its number of samples and its episodes."""
    found, before = [], 0
    for name, num_samples, episodes in parts:
        for episode in episodes:
            attributes = dict(episode.attributes)
            if PART_OF in attributes:
                attributes[PART_OF] = f"{name}/{attributes[PART_OF]}"
            found.append(
                replace(episode, id=f"{name}/{episode.id}", first=before + episode.first, attributes=attributes)
            )
        before += num_samples
    return found


def episodes_from_json(where: str, entries: Any, num_samples: int, *, error: type[PcdataError]) -> list[Episode]:
    """Read episodes from plain data of any origin.

    Raises:
        PcdataError: of the type ``error``: not a list of objects with id, first, length, times and attributes that
            fit the samples.
    """
    fields = set(Episode.__dataclass_fields__)
    if not isinstance(entries, list) or not all(isinstance(one, dict) and set(one) == fields for one in entries):
        raise error(f"{where}: episodes must be a list of objects with {', '.join(sorted(fields))}")
    try:
        return checked_episodes(where, [Episode(**one) for one in entries], num_samples)
    except (PcdataError, TypeError, ValueError, RecursionError, OverflowError) as cause:
        told = str(cause).removeprefix(f"{where}: ")
        raise error(f"{where}: {told:.500}") from cause


def _is_whole(value: object) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(value < 1 << 62)


def _is_time(value: Any) -> bool:
    # A bound instead of isfinite, which cannot take the whole numbers of any length that JSON allows.
    is_number = isinstance(value, (int, float, np.floating)) and not isinstance(value, bool)
    return is_number and bool(abs(value) < _LATEST)


def _plain(where: str, attributes: Any) -> dict[str, Any]:
    """Return attributes as JSON gives them back."""
    if isinstance(attributes, Mapping) and all(isinstance(name, str) for name in attributes):
        try:
            plain: dict[str, Any] = json.loads(json.dumps(dict(attributes), allow_nan=False))
            return plain
        except (TypeError, ValueError, RecursionError) as cause:
            raise CaptureError(f"{where}: attributes must be what JSON holds: {cause}") from cause
    raise CaptureError(f"{where}: attributes must be a mapping of names to JSON-able facts, got {attributes!r:.100}")
