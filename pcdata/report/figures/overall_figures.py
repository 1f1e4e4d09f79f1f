"""Figures on all captures together, as the page has them: cameras, episodes, gaps, planes, objects, every number.

Each is made of what was gathered alone; None where there is nothing to draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from pcdata.report.figures.figure import Panel, figure_of
from pcdata.report.figures.overall_panels import (
    Band,
    bands_panel,
    boxes_panel,
    curves_panel,
    gap_panel,
    histogram_panel,
)
from pcdata.report.figures.panels import trend_panel
from pcdata.report.html.episode_lines import EpisodeLine
from pcdata.report.html.gathering import Gathered, told_trends
from pcdata.report.html.pair_gaps import pair_gaps
from pcdata.report.html.panels.cameras import PLANES, series_of
from pcdata.report.html.panels.numbers import OWN_PANELS
from pcdata.report.html.panels.over_time import is_over_time
from pcdata.validation.by_camera import CameraHistory, cameras_of
from pcdata.verdicts import in_figures

WIDTH = 15.6  # inches of every figure
_COLUMNS = 4
_MOST_BANDS = 16
_MOST_SIGNALS = 8
_MOST_PAIRS = 12
_MOST_TRENDS = 24


def cameras_panel(gathered: Gathered) -> tuple[Panel, int] | None:
    """Return a band for every camera, with since when and by which checks it is at its worst; and how many bands."""
    grading = gathered.grading
    histories = cameras_of(grading)
    if not histories or len(grading.ids) < 2:
        return None
    title = "cameras over the captures"
    if len(histories) > _MOST_BANDS:
        title += f": the worst {_MOST_BANDS} of {len(histories)}"
        histories = sorted(histories, key=lambda camera: -camera.verdict.severity)[:_MOST_BANDS]
    bands = [Band(camera.name, _since(camera), camera.severities) for camera in histories]
    return partial(bands_panel, title=title, bands=bands, ends=(grading.ids[0], grading.ids[-1])), len(bands)


def _since(camera: CameraHistory) -> str:
    checks = ", ".join(dict.fromkeys(fault.name for fault in camera.faults))
    return f"{camera.verdict} {checks}: {camera.since}" if camera.faults else f"{camera.verdict}"


def episodes_figure(gathered: Gathered) -> Any | None:
    """Draw bands of verdicts of the worst episodes, with what is missing, and the signals of the worst one."""
    if not is_over_time(gathered):
        return None
    lines, total = gathered.lines, len(gathered.grading.episodes)
    title = "Episodes over time" if total else "Over time"
    title += f": the worst {len(lines)} of {total:,}" if total > len(lines) else ""
    ids = gathered.grading.ids
    bands = [Band(line.name or "all captures", _missing(line, ids), line.severities, _places(line)) for line in lines]
    ends = (ids[lines[0].first], ids[lines[0].first + len(lines[0].severities) - 1]) if len(lines) == 1 else None
    panels: list[Panel] = [partial(bands_panel, title="verdicts", bands=bands, ends=ends)]
    signals = [(name, values) for name, values in lines[0].signals.items() if np.isfinite(values).any()]
    for name, values in signals[:_MOST_SIGNALS]:
        series = {str(column): values[:, column] for column in range(values.shape[1])}
        told = f"{lines[0].name or 'all captures'}: {name}"
        panels.append(partial(curves_panel, title=told, series=series, places=lines[0].places))
    if len(signals) > _MOST_SIGNALS:
        title += f", {len(signals) - _MOST_SIGNALS} signals more are not shown"
    columns = min(len(panels), 3)
    height = max(2.6, 0.4 * len(bands) + 0.8)
    return figure_of(panels, title=title, columns=columns, width=WIDTH / columns, height=height)


def _places(line: EpisodeLine) -> list[int]:
    return [place for place, _ in line.gaps]


def _missing(line: EpisodeLine, ids: Sequence[str]) -> str:
    seconds = f", {line.times[-1]:.1f} s" if len(line.times) else ""
    gaps = "; ".join(f"{ids[line.first + place]} after {gap:.3g} s" for place, gap in line.gaps[:3])
    more = f" and {len(line.gaps) - 3} more" if len(line.gaps) > 3 else ""
    return f"{len(line.severities):,} captures{seconds}{f'; gaps: {gaps}{more}' if gaps else ''}"


def gaps_figure(gathered: Gathered) -> Any | None:
    """Draw how far the surfaces of every two cameras lie apart, those farthest apart first."""
    gaps = pair_gaps(pair for one in gathered.looked for pair in one.pairs)
    if not gaps:
        return None
    title = "Overlap of cameras, over the captures that are shown"
    title += f": {_MOST_PAIRS} of {len(gaps)} pairs" if len(gaps) > _MOST_PAIRS else ""
    panels: list[Panel] = [partial(gap_panel, gap=gap) for gap in gaps[:_MOST_PAIRS]]
    return figure_of(panels, title=title, columns=_COLUMNS, width=WIDTH / _COLUMNS, height=2.2)


def planes_figure(gathered: Gathered) -> Any | None:
    """Draw noise, height and tilt of the largest plane of every camera over the captures."""
    panels: list[Panel] = []
    for name, heading, unit, factor in PLANES:
        series = {view: factor * values for view, values in series_of(gathered.grading, name).items()}
        named = {f"median {in_figures(float(np.nanmedian(values)))}, {view}": values for view, values in series.items()}
        if named:
            panels.append(partial(curves_panel, title=f"{heading} [{unit}]", series=named))
    if not panels:
        return None
    return figure_of(panels, title="Planes and noise", columns=3, width=WIDTH / 3, height=2.8)


def objects_figure(gathered: Gathered) -> Any | None:
    """Draw how many objects there are and how large: over a dataset, and in the samples that are shown."""
    counts = series_of(gathered.grading, "object_count").get("object_count")
    sizes = series_of(gathered.grading, "object_size").get("object_size")
    boxes = [(one.sample_id, one.objects) for one in gathered.looked if one.objects is not None]
    panels: list[Panel] = []
    if counts is not None:
        panels.append(partial(histogram_panel, title="objects in a sample", values=counts, unit="objects", whole=True))
    if sizes is not None:
        told = "longest edge, the median of a sample"
        panels.append(partial(histogram_panel, title=told, values=100 * sizes, unit="cm"))
    if boxes:
        panels.append(partial(boxes_panel, samples=boxes))
    if not panels:
        return None
    return figure_of(panels, title="Objects", columns=3, width=WIDTH / len(panels), height=2.8)


def numbers_figure(gathered: Gathered) -> Any | None:
    """Draw every check's number over the samples, the worst first, but for those that have a figure of their own."""
    trends = [(name, trend) for name, trend in told_trends(gathered.grading) if trend.name not in OWN_PANELS]
    if not trends:
        return None
    panels: list[Panel] = [partial(trend_panel, trend=trend, name=name) for name, trend in trends[:_MOST_TRENDS]]
    more = f", {len(trends) - _MOST_TRENDS} more are in pcdata grade --json" if len(trends) > _MOST_TRENDS else ""
    title = f"Numbers over the samples{more}"
    return figure_of(panels, title=title, columns=_COLUMNS, width=WIDTH / _COLUMNS, height=2.2)
