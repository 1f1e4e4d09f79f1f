"""Episodes over time: verdicts, gaps and signals of their steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.errors import PcdataError
from pcdata.io.sources.capture_source import CaptureSource, signals_of
from pcdata.structures import Episode
from pcdata.validation.grading import Grading
from pcdata.verdicts import Verdict

_MOST_EPISODES = 12
_MOST_STEPS = 240  # of an episode whose signals are looked up
_MOST_COLUMNS = 8  # of a signal
_GAP = 2.5  # usual intervals without a capture, as the check of clocks has it


@dataclass(frozen=True, eq=False)
class EpisodeLine:
    """One episode over time.

    Args:
        name: of the episode; "" = a recording without episodes.
        first: place of its first capture.
        severities: (n,) int8 the verdict of every capture, 0 = pass to 3 = fail, -1 = none.
        times: (n,) seconds from its first step; empty where they are not known.
        gaps: places within it before which captures are missing, with the seconds since the one before.
        places: (m,) steps whose signals were looked up.
        signals: name -> (m, D) float64 of these steps; NaN where one has none.
    """

    name: str
    first: int
    severities: NDArray[np.int8]
    times: NDArray[np.float64]
    gaps: tuple[tuple[int, float], ...]
    places: NDArray[np.int64]
    signals: Mapping[str, NDArray[np.float64]]


def episode_lines(source: CaptureSource, grading: Grading) -> tuple[EpisodeLine, ...]:
    """Return up to 12 episodes over time, those with most captures that fail or warn first."""
    episodes = list(grading.episodes) or [Episode("recording", 0, len(grading.ids))]

    def badness(episode: Episode) -> tuple[int, int]:
        own = grading.sample_verdicts[episode.first : episode.first + episode.length]
        return -int((own == Verdict.FAIL.severity).sum()), -int((own == Verdict.WARN.severity).sum())

    worst = sorted(episodes, key=badness)[:_MOST_EPISODES]
    return tuple(_line(source, grading, one, "" if not grading.episodes else one.id) for one in worst)


def _line(source: CaptureSource, grading: Grading, episode: Episode, name: str) -> EpisodeLine:
    steps = np.unique(np.linspace(0, episode.length - 1, min(episode.length, _MOST_STEPS)).round().astype(np.int64))
    times = np.array(episode.times, dtype=np.float64)
    return EpisodeLine(
        name=name,
        first=episode.first,
        severities=grading.sample_verdicts[episode.first : episode.first + episode.length].copy(),
        times=times - times[:1],
        gaps=_gaps(grading, episode, times),
        places=steps,
        signals=_signals(source, [grading.ids[episode.first + int(step)] for step in steps]),
    )


def _gaps(grading: Grading, episode: Episode, times: NDArray[np.float64]) -> tuple[tuple[int, float], ...]:
    found: dict[int, float] = {}
    if len(times) > 2:
        apart = np.diff(times)
        found.update(
            {int(place) + 1: float(apart[place]) for place in (apart > _GAP * median(apart.tolist())).nonzero()[0]}
        )
    for trend in grading.trends.values():
        if trend.name == "clock":
            for place, value, severity in zip(trend.places, trend.values, trend.verdicts):
                inside = place - episode.first
                if severity >= Verdict.WARN.severity and 0 <= inside < episode.length:
                    found[inside] = value
    return tuple(sorted(found.items()))


def _signals(source: CaptureSource, ids: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Return the numbers of each signal over some captures; texts, and those of many columns, are left out."""
    found: dict[str, NDArray[np.float64]] = {}
    for place, sample_id in enumerate(ids):
        try:
            given = signals_of(source, sample_id)
        except PcdataError:
            continue
        for name, signal in given.items():
            if isinstance(signal.values, torch.Tensor) and 0 < signal.values[0].numel() <= _MOST_COLUMNS:
                values = signal.values[0].detach().cpu().double().flatten().numpy()
                rows = found.setdefault(name, np.full((len(ids), len(values)), np.nan))
                if rows.shape[1] == len(values):
                    rows[place] = values
    return found
