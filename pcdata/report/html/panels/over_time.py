"""Episodes over time: verdicts, gaps and signals of each; and how many captures of all are bad."""

from __future__ import annotations

import numpy as np

from pcdata.report.html.charts import curves, strip, verdict_legend
from pcdata.report.html.episode_lines import EpisodeLine
from pcdata.report.html.gathering import Gathered
from pcdata.report.html.page import Section
from pcdata.report.html.text import shown
from pcdata.validation.grading import Grading
from pcdata.verdicts import Verdict

_MOST_LISTED = 500
_MOST_SIGNALS = 8  # of one episode
_OPEN = 1  # episodes whose signals are seen at once


def time_panel(gathered: Gathered) -> Section | None:
    """Return the episodes over time, the worst first, or the whole recording where there are none."""
    grading = gathered.grading
    if not is_over_time(gathered):
        return None
    lines = [_line(grading, line, is_open=number < _OPEN) for number, line in enumerate(gathered.lines)]
    table = _table(grading) if len(grading.episodes) > 1 else ""
    has_gaps = any(line.gaps for line in gathered.lines)
    note = '<p class="dim">Marks above a band: captures are missing before it.</p>' if has_gaps else ""
    return Section(
        "Episodes over time" if grading.episodes else "Over time", note + "".join(lines) + verdict_legend() + table
    )


def is_over_time(gathered: Gathered) -> bool:
    """Whether there is more to tell over time than the cameras' bands do: episodes, gaps or signals."""
    if len(gathered.grading.ids) < 2:
        return False
    return len(gathered.grading.episodes) > 1 or any(line.gaps or line.signals for line in gathered.lines)


def _line(grading: Grading, line: EpisodeLine, *, is_open: bool) -> str:
    first, last = (grading.ids[line.first + step] for step in (0, len(line.severities) - 1))
    seconds = f", {line.times[-1]:.1f} s" if len(line.times) else ""
    gaps = "; ".join(f"{shown(grading.ids[line.first + place], 60)} after {gap:.3g} s" for place, gap in line.gaps[:5])
    more = f" and {len(line.gaps) - 5} more" if len(line.gaps) > 5 else ""
    signals = [
        f"<h3>{shown(name, 80)}</h3>"
        + curves({f"{column}": values[:, column] for column in range(values.shape[1])}, "")
        for name, values in [*line.signals.items()][:_MOST_SIGNALS]
        if np.isfinite(values).any()
    ]
    left = len(line.signals) - _MOST_SIGNALS
    told = (
        f'<p class="row"><b>{shown(line.name or "all captures", 120)}</b> {len(line.severities):,} captures{seconds}'
        f"{f'; gaps: {gaps}{more}' if gaps else ''}</p>"
        f"{strip(line.severities, gaps=[place for place, _ in line.gaps])}"
        f'<p class="ends"><span>{shown(first, 60)}</span><span>{shown(last, 60)}</span></p>'
    )
    if signals:
        count = f"{len(line.signals)} signal{'s' * (len(line.signals) > 1)}"
        told += (
            f"<details{' open' if is_open else ''}><summary>{count}</summary>"
            f"{''.join(signals)}"
            f"{f'<p>{left} more.</p>' if left > 0 else ''}</details>"
        )
    return told


def _table(grading: Grading) -> str:
    rows = []
    for episode in grading.episodes[:_MOST_LISTED]:
        own = grading.sample_verdicts[episode.first : episode.first + episode.length]
        counts = "".join(f'<td class="number">{int((own == verdict.severity).sum())}</td>' for verdict in Verdict)
        rows.append(f"<tr><td>{shown(episode.id, 120)}</td><td class='number'>{episode.length}</td>{counts}</tr>")
    head = "".join(f"<th>{verdict}</th>" for verdict in Verdict)
    left = len(grading.episodes) - _MOST_LISTED
    more = f"<p>{left:,} more</p>" if left > 0 else ""
    return (
        f"<details><summary>all {len(grading.episodes):,} episodes</summary>"
        f'<div class="wide"><table><tr><th>episode</th><th>captures</th>{head}</tr>{"".join(rows)}</table></div>{more}'
        "</details>"
    )
