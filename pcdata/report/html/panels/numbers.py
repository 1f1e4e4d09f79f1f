"""Every check's number over the samples, objects among them, and points after each step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pcdata.report.html.charts import bars, histogram, time_line
from pcdata.report.html.gathering import Gathered, told_trends
from pcdata.report.html.page import Section
from pcdata.report.html.panels.cameras import series_of
from pcdata.report.html.text import shown
from pcdata.validation.grading import Trend
from pcdata.verdicts import Verdict, in_figures

_MOST_TRENDS = 64  # time lines
OWN_PANELS = (
    "plane_noise",
    "plane_height",
    "plane_tilt",
    "object_count",
    "object_size",
)  # checks that are shown elsewhere


def funnel_panel(gathered: Gathered) -> Section | None:
    """Points after each step."""
    if not gathered.funnel:
        return None
    return Section("Points after each step (median)", bars(funnel_rows(gathered.funnel)))


def funnel_rows(steps: Sequence[tuple[str, float]]) -> tuple[tuple[str, float, str], ...]:
    """Return rows for bars from (step, median points after it): each with its share of the step before."""
    rows = []
    for place, (name, count) in enumerate(steps):
        before = steps[place - 1][1] if place else 0
        kept = f" ({count / before:.0%} of before)" if before else ""
        rows.append((f"{place + 1}. {name}", count, f"{count:,.0f}{kept}"))
    return tuple(rows)


def objects_panel(gathered: Gathered) -> Section | None:
    """How many objects there are and how large they are: over a dataset, and in the samples that are shown."""
    parts = []
    counts = series_of(gathered.grading, "object_count").get("object_count")
    sizes = series_of(gathered.grading, "object_size").get("object_size")
    if counts is not None:
        parts.append(f"<h3>Objects in a sample</h3>{_spread(counts, 'objects')}")
    if sizes is not None:
        parts.append(f"<h3>Longest edge, the median of a sample</h3>{_spread(100 * sizes, 'cm')}")
    boxes = [(one.sample_id, one.objects) for one in gathered.looked if one.objects is not None]
    if boxes:
        rows = "".join(
            f"<tr><td>{shown(sample_id, 80)}</td><td class='number'>{len(own)}</td><td>{_sizes(own)}</td></tr>"
            for sample_id, own in boxes
        )
        head = "<tr><th>sample</th><th>objects</th><th>boxes, length x width x height [cm]</th></tr>"
        parts.append(f'<h3>In the samples that are shown</h3><div class="wide"><table>{head}{rows}</table></div>')
    return Section("Objects", "".join(parts)) if parts else None


def _spread(values: NDArray[np.float64], unit: str) -> str:
    """A histogram; in words where all numbers are one."""
    finite = values[np.isfinite(values)]
    if len(finite) and finite.min() == finite.max():
        return (
            f"<p>{in_figures(float(finite[0]))} {unit} in {'every sample' if len(finite) > 1 else 'the only one'}</p>"
        )
    return histogram(values, unit)


def _sizes(boxes: Sequence[tuple[float, float, float]]) -> str:
    told = "; ".join(" x ".join(f"{100 * edge:.1f}" for edge in box) for box in boxes[:8])
    return f"{told}; and {len(boxes) - 8} more" if len(boxes) > 8 else told


def numbers_panel(gathered: Gathered) -> Section:
    """Every check's number; those that pass everywhere are folded."""
    told = [(name, trend) for name, trend in told_trends(gathered.grading) if trend.name not in OWN_PANELS]
    bad = [one for one in told if one[1].verdict.severity >= Verdict.WARN.severity]
    good = [one for one in told if one[1].verdict.severity < Verdict.WARN.severity]
    parts = [_trend(name, trend, gathered.grading.ids) for name, trend in bad[:_MOST_TRENDS]]
    fine = [_trend(name, trend, gathered.grading.ids) for name, trend in good[: max(_MOST_TRENDS - len(bad), 0)]]
    if fine:
        parts.append(f"<details><summary>{len(fine)} that neither warn nor fail</summary>{''.join(fine)}</details>")
    if (left := len(told) - len(bad[:_MOST_TRENDS]) - len(fine)) > 0:
        parts.append(f'<p class="dim">{left} more are in the JSON of pcdata grade.</p>')
    return Section("Numbers of the checks", "".join(parts) or '<p class="dim">No check measured a number.</p>')


def _trend(name: str, trend: Trend, ids: Sequence[str]) -> str:
    values = np.array(trend.values)
    values, limit, unit = _shown_in(values, trend.worst.threshold, trend.worst.unit)
    head = f'<h3>{shown(name)} <span class="{trend.verdict}">{trend.verdict}</span></h3>'
    passes = (
        ""
        if limit is None
        else f"; passes {'down' if trend.worst.at_least else 'up'} to {in_figures(limit)} {unit}".rstrip()
    )
    if len(values) < 2:
        return f"{head}<p>{in_figures(values[0])} {shown(unit)}{shown(passes)}</p>"
    low, high = np.nanmin(values), np.nanmax(values)
    told = (
        f"{in_figures(low)} to {in_figures(high)} {unit}".rstrip() + passes + (" (dashed)" if limit is not None else "")
    )
    spread = histogram(values, unit) if len(values) > 20 else ""
    first, last = (shown(ids[trend.places[end]], 60) for end in (0, -1))
    return (
        f'{head}<p class="dim">{shown(told)}</p><div class="charts"><div>'
        f"{time_line(values, trend.verdicts, limit=limit)}"
        f'<p class="ends"><span>{first}</span><span>{last}</span></p></div>{spread}</div>'
    )


def _shown_in(
    values: NDArray[np.float64], limit: float | None, unit: str
) -> tuple[NDArray[np.float64], float | None, str]:
    """Return numbers in a unit in which they are read easily: short lengths and times in thousandths."""
    most = max(float(np.nanmax(np.abs(values))), abs(limit or 0.0))
    if unit in ("m", "s") and most < 0.5:
        return 1e3 * values, None if limit is None else 1e3 * limit, f"m{unit}"
    return values, limit, unit
