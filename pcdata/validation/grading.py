"""One grade for a whole recording or dataset, from every check on every capture, with the reasons for it.

A recording rig's nightly job reads the letter and the exit code; a person reads which camera went wrong, since when,
and in which episodes.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.structures import Episode
from pcdata.validation.by_camera import cameras_of
from pcdata.validation.summary import SampleReport, Summary
from pcdata.verdicts import Finding, Verdict, finite_json

MOST_BAD = 0.1  # of the captures: up to that share the fault is of some captures, beyond it of the recording
LETTERS = {
    "A": "no capture warns or fails",
    "B": f"none fails, at most {MOST_BAD:.0%} warn",
    "C": f"none fails, more than {MOST_BAD:.0%} warn",
    "D": f"at most {MOST_BAD:.0%} fail",
    "F": f"more than {MOST_BAD:.0%} fail, or what all captures tell together fails, or none could be read",
}
_ORDER = tuple(Verdict)


@dataclass
class Trend:
    """One check on one view over the captures in order: 9 bytes for each.

    Args:
        name: the check.
        view: of the captures; None = the whole.
        places: (N,) which captures of the source it was asked of.
        values: (N,) what it measured; NaN = nothing.
        verdicts: (N,) the severity of each verdict.
        worst: the first finding of the worst verdict.
    """

    name: str
    view: int | None
    places: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))
    verdicts: array[int] = field(default_factory=lambda: array("b"))
    worst: Finding = field(default_factory=lambda: Finding(name=""))

    def add(self, place: int, finding: Finding) -> None:
        """Take the finding on one more capture."""
        if not self.places or finding.verdict.severity > self.worst.verdict.severity:
            self.worst = finding
        self.places.append(place)
        self.values.append(np.nan if finding.value is None else finding.value)
        self.verdicts.append(finding.verdict.severity)

    @property
    def verdict(self) -> Verdict:
        """The worst verdict."""
        return self.worst.verdict

    def where_worst(self) -> NDArray[np.int64]:
        """Return the places of the captures with the worst verdict, rising."""
        return np.array(self.places)[np.array(self.verdicts) == self.verdict.severity]

    def since(self) -> tuple[int, bool]:
        """Return the place of the first capture with the worst verdict, and whether all after it have it too."""
        where = self.where_worst()
        first = int(where[0])
        after = np.array(self.places) >= first
        return first, len(where) > 1 and bool((np.array(self.verdicts)[after] == self.verdict.severity).all())


@dataclass(frozen=True)
class Grade:
    """What a recording or dataset is worth, and why.

    Args:
        letter: A to F, by the rules of :data:`LETTERS`.
        reasons: what keeps it from an A, worst first; each says which check, which view, since when, and what to do.
    """

    letter: str
    reasons: tuple[str, ...]


class Grading:
    """Grades captures as their reports come, in memory of some bytes for every check of a capture.

    Args:
        ids: the captures, in order.
        episodes: over them, where the source has some.
    """

    def __init__(self, ids: Sequence[str], episodes: Sequence[Episode] = ()) -> None:
        self.ids = ids
        self.episodes = episodes
        self.names: list[str] = []  # of the views, such as "view 0 (wrist)"; the number alone where captures differ
        self.summary = Summary()
        self.trends: dict[tuple[str, int | None], Trend] = {}
        self.together: list[tuple[str, Finding]] = []  # about all captures of a recording: its name, what was found
        self.sample_verdicts = np.full(len(ids), -1, dtype=np.int8)  # severity; -1 = no report yet
        self._place = 0
        self._num_refused = 0

    def add(self, report: SampleReport) -> None:
        """Take the report on the next capture, or on a recording."""
        self.summary.add(report)
        if report.whole:
            self.together += [(report.sample_id, finding) for finding in report.findings]
            return
        for view, name in enumerate(report.views):
            if view == len(self.names):
                self.names.append(name)
            elif self.names[view] != name:
                self.names[view] = f"view {view}"
        place, self._place = self._place, self._place + 1
        self.sample_verdicts[place] = report.verdict.severity
        self._num_refused += report.refused
        for finding in report.findings:
            key = (finding.name, finding.view)
            self.trends.setdefault(key, Trend(*key)).add(place, finding)

    def count(self, verdict: Verdict) -> int:
        """How many captures have this verdict."""
        return int((self.sample_verdicts == verdict.severity).sum())

    @property
    def none_read(self) -> bool:
        """Whether no capture could be read, of those that came so far."""
        return self._num_refused == self._place

    def grade(self) -> Grade:
        """Grade what came so far."""
        graded = max(int((self.sample_verdicts >= 0).sum()), 1)
        failing, warning = self.count(Verdict.FAIL) / graded, self.count(Verdict.WARN) / graded
        together = {finding.verdict for _, finding in self.together}
        if Verdict.FAIL in together or failing > MOST_BAD or self.none_read:
            letter = "F"
        elif failing:
            letter = "D"
        elif warning > MOST_BAD or Verdict.WARN in together:
            letter = "C"
        else:
            letter = "B" if warning else "A"
        return Grade(letter, tuple(self._reasons()))

    def standing(self) -> str:
        """Say in one line what the letter rests on, such as ``3 of 40 captures fail, 5 warn``."""
        if self.none_read:
            return "no capture could be read"
        graded = int((self.sample_verdicts >= 0).sum())
        of = f"of {graded:,} capture{'s' * (graded != 1)}"
        told = [
            f"{count:,} {of if not number else ''}".rstrip() + f" {word}{'s' * (count == 1)}"
            for number, (count, word) in enumerate(
                (self.count(verdict), word)
                for verdict, word in ((Verdict.FAIL, "fail"), (Verdict.WARN, "warn"))
                if self.count(verdict)
            )
        ] or [f"none {of} warns or fails"]
        if unknown := self.count(Verdict.UNKNOWN):
            told.append(f"of {unknown:,} something could not be measured")
        whole = [finding.verdict for _, finding in self.together]
        for verdict, word in ((Verdict.FAIL, "fails"), (Verdict.WARN, "warns")):
            if verdict in whole:
                told.append(f"a check over all captures {word}")
                break
        return ", ".join(told)

    def faults(self) -> list[Trend]:
        """The trends that warn or fail, worst first; of as bad ones those of more captures."""
        bad = [trend for trend in self.trends.values() if trend.verdict.severity >= Verdict.WARN.severity]
        return sorted(bad, key=lambda trend: (-trend.verdict.severity, -len(trend.where_worst())))

    def faults_at(self, place: int) -> list[str]:
        """Name the checks, each with its view, that warn or fail of one capture, the worst first."""
        named = []
        for trend in self.faults():
            row = bisect_left(trend.places, place)
            if row < len(trend.places) and trend.places[row] == place:
                named.append((trend.verdicts[row], " ".join(filter(None, [trend.name, self.name_of(trend.view)]))))
        bad = [one for one in named if one[0] >= Verdict.WARN.severity]
        return [name for _, name in sorted(bad, key=lambda one: -one[0])]

    def name_of(self, view: int | None) -> str:
        """What the page and the text call a view; nothing where it is the whole."""
        if view is None:
            return ""
        return self.names[view] if view < len(self.names) else f"view {view}"

    def since_text(self, trend: Trend) -> str:
        """Say in how many captures, from which on, and in which episodes."""
        where = trend.where_worst()
        first, ever_since = trend.since()
        total = len(trend.places)
        if trend.view is None and {*trend.verdicts} == {Verdict.FAIL.severity}:
            total = int((self.sample_verdicts >= 0).sum())  # what a reader refuses is a check of what it refused alone
        told = f"in {len(where):,} of {total:,} captures"
        if len(where) == total > 1:
            return f"in all {len(where):,} captures"
        told += f", from {self.ids[first]!r} on" if ever_since else f", first {self.ids[first]!r}"
        if trend.verdict is Verdict.FAIL and (warning := list(trend.verdicts).count(Verdict.WARN.severity)):
            told += f"; {warning:,} more warn{'s' * (warning == 1)}"
        if len(self.episodes) > 1 and (bad := self._episodes_of(where)):
            shown = ", ".join(f"{name} ({count})" for name, count in bad.most_common(3))
            told += f"; episodes {shown}" + (f" and {len(bad) - 3} more" if len(bad) > 3 else "")
        return told

    def _episodes_of(self, places: Iterable[int]) -> Counter[str]:
        firsts = np.array([episode.first for episode in self.episodes])
        if not len(firsts):
            return Counter()
        order = np.argsort(firsts)
        inside = order[np.searchsorted(firsts[order], np.array([*places]), side="right") - 1]
        return Counter(self.episodes[int(number)].id for number in inside)

    def _reasons(self) -> Iterable[str]:
        if self.none_read:
            yield "no capture could be read"
        for severity in (Verdict.FAIL, Verdict.WARN):
            for name, finding in self.together:
                if finding.verdict is severity:
                    about = " ".join(filter(None, [finding.name, self.name_of(finding.view)]))
                    yield f"{severity} {about}, all captures of {name}: {finding.found}; {finding.advice}".rstrip("; ")
            for trend in self.faults():
                if trend.verdict is severity:
                    about = " ".join(filter(None, [trend.name, self.name_of(trend.view)]))
                    found = f"{trend.worst.found}; {trend.worst.advice}".rstrip("; ")
                    yield f"{severity} {about}, {self.since_text(trend)}: {found}"

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON: the grade, every check by view with its trend, every episode."""
        grade = self.grade()
        return finite_json(
            {
                "schema": "pcdata.grade/1",
                "grade": grade.letter,
                "rule": LETTERS[grade.letter],
                "reasons": list(grade.reasons),
                "captures": {verdict.value: self.count(verdict) for verdict in Verdict},
                "checks": [self._trend_json(trend) for trend in self.trends.values()],
                "cameras": [camera.to_json() for camera in cameras_of(self)],
                "together": [{"recording": name, **finding.to_json()} for name, finding in self.together],
                "episodes": [self._episode_json(episode) for episode in self.episodes],
            }
        )

    def _trend_json(self, trend: Trend) -> dict[str, Any]:
        values = np.array(trend.values)
        finite = values[np.isfinite(values)]
        verdicts = Counter(_ORDER[severity].value for severity in trend.verdicts)
        first, ever_since = trend.since()
        spread = dict(zip(("min", "median", "max"), np.quantile(finite, [0, 0.5, 1]).tolist())) if len(finite) else None
        return {
            "name": trend.name,
            "view": trend.view,
            "view_name": self.name_of(trend.view),
            "verdict": trend.verdict,
            "counts": dict(verdicts),
            "values": spread,
            "unit": trend.worst.unit,
            "threshold": trend.worst.threshold,
            "first": self.ids[first] if trend.verdict is not Verdict.PASS else None,
            "ever_since": ever_since if trend.verdict is not Verdict.PASS else None,
            "found": trend.worst.found,
            "advice": trend.worst.advice,
        }

    def _episode_json(self, episode: Episode) -> dict[str, Any]:
        own = self.sample_verdicts[episode.first : episode.first + episode.length]
        counts = {verdict.value: int((own == verdict.severity).sum()) for verdict in Verdict}
        return {"id": episode.id, "first": episode.first, "length": episode.length, "captures": counts}
