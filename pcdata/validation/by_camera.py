"""What the checks say of each camera over the captures: how bad, since when, and by which checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pcdata.verdicts import Verdict

if TYPE_CHECKING:
    from pcdata.validation.grading import Grading, Trend


@dataclass(frozen=True, eq=False)
class CameraHistory:
    """One camera over the captures.

    Args:
        view: its number in the captures.
        name: what it is called.
        severities: (N,) int8 the worst verdict of each capture's checks on it, 0 = pass to 3 = fail; -1 = none. What
            could not be measured counts where nothing else was.
        faults: the checks that warned or failed, the worst first.
        since: in words, in how many captures it was at its worst, and from which on; "" = nothing was found.
    """

    view: int
    name: str
    severities: NDArray[np.int8]
    faults: tuple[Trend, ...]
    since: str

    @property
    def verdict(self) -> Verdict:
        """The worst."""
        return list(Verdict)[max(int(self.severities.max(initial=0)), 0)]

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        counts = {verdict.value: int((self.severities == verdict.severity).sum()) for verdict in Verdict}
        checks = [fault.name for fault in self.faults]
        return {"view": self.view, "name": self.name, "counts": counts, "since": self.since, "checks": checks}


def cameras_of(grading: Grading) -> list[CameraHistory]:
    """Return every camera that checks judged, in the order of the views."""
    views = sorted({view for _, view in grading.trends if view is not None})
    return [_history(grading, view) for view in views]


def _history(grading: Grading, view: int) -> CameraHistory:
    own = [trend for trend in grading.trends.values() if trend.view == view]
    severities = np.full(len(grading.ids), -1, dtype=np.int8)
    unmeasured = np.zeros(len(grading.ids), dtype=bool)
    for trend in own:
        places, verdicts = np.array(trend.places), np.array(trend.verdicts, dtype=np.int8)
        measured = verdicts != Verdict.UNKNOWN.severity
        severities[places[measured]] = np.maximum(severities[places[measured]], verdicts[measured])
        unmeasured[places[~measured]] = True
    severities[(severities < 0) & unmeasured] = Verdict.UNKNOWN.severity
    faults = tuple(fault for fault in grading.faults() if fault.view == view)
    return CameraHistory(view, grading.name_of(view), severities, faults, _since(grading, severities) if faults else "")


def _since(grading: Grading, severities: NDArray[np.int8]) -> str:
    judged = severities[severities >= 0]
    worst = severities == judged.max()
    count, total = int(worst.sum()), len(judged)
    if count == total > 1:
        return f"in all {total:,} captures"
    first = int(worst.argmax())
    after = severities[first:]
    ever_since = count > 1 and bool((after[after >= 0] == judged.max()).all())
    told = f"from {grading.ids[first]!r} on" if ever_since else f"first {grading.ids[first]!r}"
    return f"{told}, in {count:,} of {total:,} captures"
