"""Two sources side by side: simulation against real, yesterday against today.

Every capture becomes some dozen numbers. What differs between the sources by more than captures of one source do is a
difference. For each there is looked for a step that closes it; it is tried, and everything is measured again: so what
only followed from it is told from what differs by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from pcdata.errors import CaptureError, ConfigError
from pcdata.io.sources.capture_source import CaptureSource, checked_ids
from pcdata.threads import torch_on_one_thread
from pcdata.validation.comparison.advice import difference_of_fact, fact_differences, family_advice
from pcdata.validation.comparison.changes import Finder, find_crop, find_offset, find_size, find_unit
from pcdata.validation.comparison.changes_of_noise import find_density, find_holes, find_jitter, find_sensor_noise
from pcdata.validation.comparison.description import Key, Series
from pcdata.validation.comparison.placements import place
from pcdata.validation.comparison.quantities import QUANTITIES, title_of
from pcdata.validation.comparison.result import Comparison, Difference, Measured
from pcdata.validation.comparison.sides import Change, Side
from pcdata.validation.comparison.statistics import FEWEST
from pcdata.validation.comparison.tables import Table, bad, table_of
from pcdata.verdicts import Verdict, worst

Progress = Callable[[int, int, str], None]

CAPTURES = 100  # of each source, unless told otherwise
_FINDERS: tuple[Finder, ...] = (
    *(find_unit, find_size, find_crop, find_offset),
    *(find_sensor_noise, find_holes, find_jitter, find_density),
)
_SHOWN = 4  # numbers of a difference that are told in words


@torch_on_one_thread()
def compare_sources(
    a: CaptureSource, b: CaptureSource, *, captures: int = CAPTURES, progress: Progress | None = None
) -> Comparison:
    """Say how two sources differ, by how much, and which step closes each difference.

    Depth images are compared with depth images and clouds with clouds; where one source has clouds, the depth images of
    the other are compared by their points. One capture is held at a time. A number differs where the means of the
    middle 60 % of its captures are farther apart than the limit, and than captures of one source are by chance: Yuen's
    test, with captures that are alike counted as fewer, all numbers together wrong in one of a hundred comparisons
    (Holm's rule).

    Args:
        a: captures or stored clouds.
        b: others.
        captures: measured of each source, spread evenly over it.
        progress: told (captures measured, all, which).

    Raises:
        CaptureError: a source is empty, or none of its captures can be read.
        DTypeError: what is no source.
        ConfigError: ``captures`` is below 1.
    """
    if captures < 1:
        raise ConfigError(f"compare_sources: captures must be 1 or more, got {captures}")
    for source in (a, b):
        checked_ids("compare_sources", source)
    return _Comparing(Side(a, captures), Side(b, captures), progress).result()


class _Comparing:
    def __init__(self, a: Side, b: Side, progress: Progress | None) -> None:
        self.sides = a, b
        self._progress = progress
        self._done, self._total = 0, len(a.ids) + len(b.ids)
        self.tried: list[tuple[Change, Table, set[Key], bool]] = []  # kept: how it was before, what closed, whether all

    def result(self) -> Comparison:
        self._choose_kind()
        for side in self.sides:
            side.series = self._measured(side, ())
            if not side.series.count and side.unit_error is None:
                why = next(iter(side.refused.values()), "")
                raise CaptureError(f"compare_sources: no capture of {side.source!r} can be read; the first: {why}")
        unreadable = [place for place, side in enumerate(self.sides) if not side.series.count]
        if unreadable:
            return self._unreadable(unreadable)
        first = table = self._table()
        for finder in _FINDERS:
            change = finder(self.sides, table)
            if change is not None:
                table = self._try(change, table)
        return self._told(first, table)

    def _choose_kind(self) -> None:
        """Compare depth images by their points where the other source has none."""
        from pcdata.structures import PointCloud

        loaded = [next((one for name in side.ids if (one := side.load(name)) is not None), None) for side in self.sides]
        if any(isinstance(one, PointCloud) for one in loaded):
            for side, one in zip(self.sides, loaded):
                side.clouds = not isinstance(one, PointCloud)

    def _measured(self, side: Side, changes: tuple[Change, ...]) -> Series:
        letter = "AB"[self.sides.index(side)]
        trying = f", trying {changes[-1].name}" if changes else ""

        def told(sample_id: str) -> None:
            self._done += 1
            if self._progress is not None:
                self._progress(self._done, max(self._total, self._done), f"{letter} {sample_id}{trying}")

        return side.measure(changes, told)

    def _table(self) -> Table:
        a, b = self.sides
        views = sorted(
            {key[1] for side in self.sides for key in side.series.keys}, key=lambda one: -1 if one is None else one
        )
        place(a.series, b.series, views)
        shared = {key for key in a.judged & b.judged if _is_usual(key, a.series, b.series)}
        if a.fact("frame") != b.fact("frame"):
            shared = {key for key in shared if not _needs_frame(key[0])}
        return table_of(a.series, b.series, sorted(shared, key=lambda key: (str(key[1]), key[0])))

    def _try(self, change: Change, table: Table) -> Table:
        """Measure once more with the change; it is kept where what it is for is no worse, and less differs."""
        side = self.sides[change.side]
        before, kept = side.series, side.changes
        self._total += len(side.ids)
        try:
            side.series = self._measured(side, (*kept, change))
        except CaptureError:
            side.series = before
            return table
        side.changes = (*kept, change)
        after = self._table()
        were, are = bad(table), bad(after)
        aimed = {key for key in were if table[key].family in change.families}
        closed = were - are
        whole = {table[key].family for key in aimed} - {after[key].family for key in are}
        known = are & table.keys()  # a unit set right makes numbers comparable that were not
        better = bool(whole) and len(known) < len(were)
        if change.needs_more:
            better &= any(table[key].family not in change.families for key in closed)
        if not (better or (change.name == "image size" and len(known) <= len(were))):
            side.series, side.changes = before, kept
            self._table()
            return table
        self.tried.append((change, table, closed, not (aimed & are)))
        return after

    # -- what is told --------------------------------------------------------------------------------------------------

    def _told(self, first: Table, last: Table) -> Comparison:
        left = {one.family for one in last.values() if one.differs}
        differences = [
            *(one for one in fact_differences(self.sides) if not self._is_closed(one.name)),
            *(one for tried in self.tried for one in _of_change(*tried, left)),
            *self._left(last),
        ]
        a, b = self.sides
        measured = [
            replace(one, left=last[key].verdict if key in last else one.verdict)
            for key, one in {**last, **first}.items()
        ]
        return Comparison(
            names=(_name(a.source), _name(b.source)),
            captures=(a.series.count, b.series.count),
            of=(len(a.all_ids), len(b.all_ids)),
            differences=tuple(sorted(differences, key=lambda one: -one.verdict.severity)),
            measured=tuple(measured),
            not_compared=tuple(self._not_compared()),
            refused=(a.refused, b.refused),
        )

    def _is_closed(self, name: str) -> bool:
        return any(change.name == name for change, *_ in self.tried)

    def _left(self, last: Table) -> Iterable[Difference]:
        """Yield what differs by itself, family by family."""
        families: dict[str, list[Measured]] = {}
        for key in bad(last):
            families.setdefault(last[key].family, []).append(last[key])
        partly = {before[key].family: change for change, before, closed, _ in self.tried for key in closed}
        for family, rows in families.items():
            advice = family_advice(family, rows)
            if family in partly:
                advice = f"{advice}; of what is left after {partly[family].name} was closed"
            yield Difference(name=family, verdict=worst(one.verdict for one in rows), found=_words(rows), advice=advice)

    def _not_compared(self) -> Iterable[str]:
        a, b = self.sides
        for one, other, letter in ((a, b, "A"), (b, a, "B")):
            lacking = {key[0].partition("@")[0] for key in one.judged} - {
                key[0].partition("@")[0] for key in other.judged
            }
            if lacking:
                yield f"only {letter} has {', '.join(title_of(name) for name in sorted(lacking))}"
        if a.fact("frame") != b.fact("frame"):
            yield f"places in {a.fact('frame')!r} and {b.fact('frame')!r}: other frames"
        for side, letter in zip(self.sides, "AB"):
            if side.clouds:
                yield f"the images of {letter}: the other source has clouds, so its points are compared"

    def _unreadable(self, places: list[int]) -> Comparison:
        """Return that a source is in another unit, so that none of its captures can be read."""
        a, b = self.sides
        found = [difference_of_fact("unit", f"{'AB'[one]}: {self.sides[one].unit_error}") for one in places]
        return Comparison(
            names=(_name(a.source), _name(b.source)),
            captures=(a.series.count, b.series.count),
            of=(len(a.all_ids), len(b.all_ids)),
            differences=tuple(found),
            measured=(),
            not_compared=("everything else: nothing can be read before that",),
            refused=(a.refused, b.refused),
        )


def _of_change(change: Change, before: Table, closed: set[Key], whole: bool, left: set[str]) -> Iterable[Difference]:
    """Yield the differences that a step closes; by family where it closes several."""
    rows = [before[key] for key in sorted(closed, key=str) if before[key].family not in left]
    own = [one for one in rows if one.family in change.families]
    explained = tuple(one.told for one in rows if one.family not in change.families)
    facts: dict[str, Any] = {"advice": change.advice, "step": change.step, "on": "AB"[change.side], "closed": whole}
    if change.name != "noise":
        verdict = worst([Verdict.WARN, *(one.verdict for one in own)])
        found = "; ".join(filter(None, [change.found, "" if change.found and not own else _words(own)]))
        yield Difference(name=change.name, verdict=verdict, found=found, explains=explained, **facts)
        return
    for family in dict.fromkeys(one.family for one in own):
        of_family = [one for one in own if one.family == family]
        verdict = worst(one.verdict for one in of_family)
        yield Difference(name=family, verdict=verdict, found=_words(of_family), explains=explained, **facts)
        explained = ()


def _words(rows: list[Measured]) -> str:
    rows = sorted(rows, key=lambda one: -abs(one.b - one.a) / max(one.passes, 1e-12))
    more = f"; and {len(rows) - _SHOWN} more numbers" if len(rows) > _SHOWN else ""
    return "; ".join(one.told for one in rows[:_SHOWN]) + more


def _is_usual(key: Key, a: Series, b: Series) -> bool:
    """Whether a number is more than the chance of a few captures."""
    counts = [int(np.isfinite(one.values(*key)).sum()) for one in (a, b)]
    return all(count >= min(FEWEST, one.count) for count, one in zip(counts, (a, b)))


def _needs_frame(name: str) -> bool:
    return QUANTITIES[name.partition("@")[0]].family in ("table", "extent") or name.startswith(
        ("camera_x", "camera_y", "camera_z", "turned_")
    )


def _name(source: Any) -> str:
    return str(getattr(source, "path", "") or getattr(source, "folder", "") or getattr(source, "name", "") or source)
