"""The captures of one source as they are compared: a sample of them, after the steps that are tried on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pcdata.errors import CaptureError, DTypeError, PcdataError, UnitError
from pcdata.io.sources.capture_source import REFUSALS, CaptureSource, reason_of
from pcdata.structures import DepthFrame, PointCloud
from pcdata.validation.comparison.description import Series, as_cloud, describe
from pcdata.validation.comparison.quantities import QUANTITIES

Capture = DepthFrame | PointCloud


@dataclass(frozen=True)
class Change:
    """What is tried on the captures of one source, to close a difference.

    Args:
        name: of the difference that it closes.
        side: 0 = A, 1 = B.
        families: what it is meant to close.
        apply: makes a capture of a capture and its id.
        advice: what a user does.
        step: the step of a pipeline that does it, ``{name: fields}``.
        found: the difference in words, where its numbers do not say it.
        needs_more: whether it is believed only where numbers of other families are closed with its own.
    """

    name: str
    side: int
    families: frozenset[str]
    apply: Callable[[Any, str], Any]
    advice: str
    step: dict[str, Any] = field(default_factory=dict)
    found: str = ""
    needs_more: bool = False


class Side:
    """One source."""

    def __init__(self, source: CaptureSource, most: int) -> None:
        self.source = source
        self.all_ids = list(source.ids)
        count = len(self.all_ids)
        places = np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))
        self.ids = [self.all_ids[place] for place in places.tolist()]
        self.refused: dict[str, str] = {}
        self.unit_error: UnitError | None = None
        self.clouds = False  # whether depth images are compared by their points
        self.changes: tuple[Change, ...] = ()
        self.series = Series()

    def load(self, sample_id: str, changes: tuple[Change, ...] | None = None) -> Capture | None:
        """Return a capture after the changes; None where it cannot be read."""
        if sample_id in self.refused:
            return None
        try:
            capture = self.source.load(sample_id)
        except REFUSALS as error:
            self.refused[sample_id] = reason_of(error)
            self.unit_error = error if isinstance(error, UnitError) else self.unit_error
            return None
        if not isinstance(capture, (DepthFrame, PointCloud)):
            raise DTypeError(
                f"compare: {self.source!r} gives a {type(capture).__name__} for {sample_id!r}; load must return a "
                "DepthFrame or a PointCloud"
            )
        if self.clouds and isinstance(capture, DepthFrame):
            capture = as_cloud(capture)
        for change in self.changes if changes is None else changes:
            try:
                capture = change.apply(capture, sample_id)
            except PcdataError as error:  # a cloud that is empty after a crop, say
                raise CaptureError(f"compare: {sample_id!r}: {change.name} cannot be tried: {error}") from error
        return capture

    def measure(self, changes: tuple[Change, ...], told: Callable[[str], None]) -> Series:
        """Measure all captures after some changes."""
        series = Series()
        for sample_id in self.ids:
            if (capture := self.load(sample_id, changes)) is not None:
                series.add(describe(capture))
            told(sample_id)
        return series

    def some(self, most: int) -> list[tuple[str, Capture]]:
        """Return a few captures after the changes, spread over the source."""
        ids = [one for one in self.ids if one not in self.refused]
        places = np.unique(np.linspace(0, len(ids) - 1, min(most, len(ids))).round().astype(int))
        loaded = ((ids[place], self.load(ids[place])) for place in places.tolist())
        return [(sample_id, capture) for sample_id, capture in loaded if capture is not None]

    def fact(self, name: str) -> str:
        """What most captures say."""
        said = self.series.facts.get(name)
        return said.most_common(1)[0][0] if said else ""

    def middle(self, name: str) -> float:
        """The median of a number over captures and views; NaN where there is none."""
        values = np.concatenate([[np.nan], *(self.series.values(*key) for key in self.series.keys if key[0] == name)])
        return float(np.nanmedian(values)) if np.isfinite(values).any() else float("nan")

    def extreme(self, name: str, largest: bool) -> float:
        """The largest or smallest of a number over captures and views."""
        columns = [self.series.values(*key) for key in self.series.keys if key[0] == name]
        values = np.concatenate([[np.nan], *columns])
        return float((np.nanmax if largest else np.nanmin)(values)) if np.isfinite(values).any() else float("nan")

    @property
    def judged(self) -> set[tuple[str, int | None]]:
        """The numbers that are judged."""
        return {key for key in self.series.keys if QUANTITIES[key[0].partition("@")[0]].limits is not None}
