"""The one protocol of everything that captures come from, and what may be asked of anything that keeps it."""

from __future__ import annotations

import glob
import itertools
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

from pcdata.errors import (
    CaptureError,
    ConfigError,
    DTypeError,
    NonFiniteError,
    NoPlaneError,
    PcdataError,
    PoseError,
    TooFewPointsError,
    UnitError,
)
from pcdata.files.inputs import Inputs
from pcdata.files.sample_names import check_text
from pcdata.structures import DepthFrame, Episode, PointCloud, Signal
from pcdata.structures.episodes import checked_episodes

# What is wrong with one capture, not with what is asked of all of them.
REFUSALS = (CaptureError, PoseError, UnitError, NonFiniteError, TooFewPointsError, NoPlaneError)


class CaptureSource(Protocol):
    """Named captures, each loaded on demand: a capture on disk, a synthetic one, one made of others, a built dataset.

    Loading an id twice gives the same capture, in any order and in any process: a source can be pickled.

    One that knows which captures follow each other has ``episodes`` too, a list of :class:`Episode` over its ids. One
    whose captures have signals has ``signals(id)``, which gives those of a capture, as it has them, without loading it.
    """

    @property
    def name(self) -> str:
        """What the captures are called together, such as the name of their folder."""

    @property
    def ids(self) -> list[str]:
        """The sample ids, unique and in a fixed order."""

    def __len__(self) -> int:
        """Return how many there are."""

    def load(self, sample_id: str) -> DepthFrame | PointCloud:
        """Load one capture.

        Raises:
            CaptureError: no capture has this id, or it cannot be trusted.
        """


def checked_ids(where: str, source: Any) -> list[str]:
    """Return the ids of a source that can be read as a whole.

    Raises:
        DTypeError: it is no source.
        CaptureError: it has no samples, two with one id, or an id that no file can hold.
    """
    if not hasattr(source, "ids") or not hasattr(source, "load"):
        raise DTypeError(
            f"{where}: source must have ids and load(id), got {type(source).__name__}; pcdata.open_source(path) makes "
            "one of a folder or file"
        )
    ids = list(source.ids)
    if not ids:
        raise CaptureError(f"{where}: {source!r} has no samples")
    if len(set(ids)) != len(ids):
        twice = next(name for name in ids if ids.count(name) > 1)
        raise CaptureError(f"{where}: {source!r}: sample ids must be unique, but {twice!r} comes more than once")
    check_text(where, ids)
    return ids


def all_within(source: Any) -> Iterator[Any]:
    """Yield a source, and every source that it is made of."""
    yield source
    for inner in getattr(source, "sources", ()):
        yield from all_within(inner)


def recordings_of(source: Any) -> list[list[str]]:
    """Return the ids by the recording that they are of, in order: nothing is averaged or compared from one to the next.

    There is one, unless sources were joined or have episodes: then every episode is one, and so is what lies between.
    """
    recordings = getattr(source, "recordings", None)
    found = recordings() if callable(recordings) else [list(source.ids)]
    episodes = episodes_of(source)
    if not episodes:
        return found
    ids = list(source.ids)
    borders = {ids[edge] for one in episodes for edge in (one.first, one.first + one.length) if edge < len(ids)}
    return [part for recording in found for part in _cut_before(recording, borders)]


def _cut_before(ids: list[str], borders: set[str]) -> list[list[str]]:
    edges = [0, *(n for n in range(1, len(ids)) if ids[n] in borders), len(ids)]
    return [ids[start:stop] for start, stop in itertools.pairwise(edges)]


def episodes_of(source: Any) -> list[Episode]:
    """Return the episodes that a source has, in the order of its ids; none of one that says nothing of them.

    Raises:
        DTypeError, CaptureError: what it gives is no such list.
    """
    given = getattr(source, "episodes", None)
    return checked_episodes(str(source), given, len(source)) if given else []


def signals_of(source: Any, sample_id: str) -> Mapping[str, Signal]:
    """Return the signals of one capture, B = 1, without loading it; none of a source that says nothing of them."""
    signals = getattr(source, "signals", None)
    return signals(sample_id) if callable(signals) else {}


def inputs_of(source: Any) -> Inputs:
    """Return what was read to open a source, and the sources that it is made of."""
    found = Inputs()
    for one in all_within(source):
        if isinstance(own := getattr(one, "inputs", None), Inputs):
            found.add(own)
    return found


def kinds_of(source: Any) -> list[str]:
    """Return the names of the combinators and layouts that a source is made of, the outermost first, each once."""
    return [*dict.fromkeys(kind for one in all_within(source) if isinstance(kind := getattr(one, "kind", None), str))]


def skipped_of(source: Any) -> dict[str, str]:
    """Return what was left out of a source, and of those that it is made of: id -> why."""
    return dict(getattr(source, "skipped", {}))


def unread_of(source: Any) -> list[str]:
    """Say in words what lies in the captures but is not read, one line for each; nothing of it is an error."""
    unread = getattr(source, "unread", None)
    return unread() if callable(unread) else []


def streams_of(source: Any) -> list[dict[str, Any]]:
    """Return the streams that recordings were joined of, JSON-able: what was dropped, doubled and interpolated."""
    return [dict(stream) for one in all_within(source) for stream in getattr(one, "streams", ())]


def refused_captures(source: CaptureSource) -> dict[str, str]:
    """Load every capture once and return those that are refused, with the reason of each.

    ``source.without(refused_captures(source))`` is the source that loads throughout.
    """
    refused = {}
    for sample_id in checked_ids("refused_captures", source):
        try:
            source.load(sample_id)
        except REFUSALS as error:
            refused[sample_id] = reason_of(error)
    return refused


def reason_of(error: PcdataError) -> str:
    """Return why a capture was refused, in one line."""
    return f"{type(error).__name__}: {str(error).splitlines()[0]}"


def check_apart(where: str, target: str | os.PathLike[str], source: Any) -> None:
    """Require that what is to be written, and all that it may replace, lies apart from what is read.

    Args:
        where: who asks, for the message.
        target: the file or folder that is to be written.
        source: captures, a dataset, or a path.

    Raises:
        ConfigError: the target is among the captures, would be joined to them by the pattern that they were opened
            with, or holds them.
    """
    place = Path(os.path.realpath(Path(target).expanduser()))
    paths, pattern = _places_of(source)
    for path in paths:
        real = Path(os.path.realpath(Path(path).expanduser()))
        if place == real and not real.is_dir():
            raise ConfigError(f"{where}: {place} is what is read; choose another file")
        if place.is_relative_to(real):
            raise ConfigError(
                f"{where}: {place} is inside the captures {real}, and would become part of them; choose a place outside"
            )
        if real.is_relative_to(place):
            raise ConfigError(f"{where}: {place} holds the captures {real}, so nothing may be put in its place")
        if glob.has_magic(pattern) and real.match(pattern):
            whole = str(Path(*real.parts[: -len(Path(pattern).parts)], pattern))
            if any(part.match(whole) for part in (place, *place.parents)):
                raise ConfigError(
                    f"{where}: {place} fits the pattern {whole}, so it would be read as captures too, the next time; "
                    "choose another place"
                )


def _places_of(source: Any) -> tuple[list[str | os.PathLike[str]], str]:
    """Return where captures, or a dataset, lie, and the pattern of several that were joined."""
    if isinstance(source, (str, os.PathLike)):
        path = Path(source).expanduser()
        matches = glob.glob(str(path)) if glob.has_magic(str(path)) and not path.exists() else []
        return [*matches] or [source], Path(os.path.abspath(path)).as_posix() if matches else ""
    source = getattr(source, "source", source)  # of a dataset that processes captures as they are read
    places = []
    for one in all_within(source):
        for name in ("path", "folder"):
            if isinstance(place := getattr(one, name, None), (str, os.PathLike)):
                places.append(place)
    return places, str(getattr(source, "opened", {}).get("path", ""))
