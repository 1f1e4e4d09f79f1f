"""The page on captures: are they good, what is wrong, since when, and what do they look like."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from pcdata import __version__
from pcdata.io.sources.capture_source import CaptureSource
from pcdata.report.html.charts import VERDICT_COLORS, bars, histogram, time_line
from pcdata.report.html.gathering import NUM_SHOWN, Gathered, Known, Looked, Progress, gather_captures, told_trends
from pcdata.report.html.page import Section, page_of
from pcdata.report.html.pictures import png_uri
from pcdata.report.html.text import shown
from pcdata.transforms import Compose
from pcdata.validation import CaptureLimits
from pcdata.validation.grading import LETTERS, Grading
from pcdata.verdicts import Finding, Verdict

_MOST_TRENDS = 24  # time lines
_MOST_LISTED = 200  # captures that were left out


def capture_page(
    source: CaptureSource,
    *,
    pipeline: Compose | None = None,
    limits: CaptureLimits | None = None,
    num_shown: int = NUM_SHOWN,
    title: str = "",
    progress: Progress | None = None,
    known: Known | None = None,
) -> tuple[str, Grading]:
    """Judge every capture of a source and return a self-contained page, and the grades it tells of.

    Args:
        source: anything with ``ids`` and ``load``.
        pipeline: steps to be shown too; its random ones are left out. None = the cloud that each capture shows.
        limits: of the checks; None = the defaults, for a camera above a table.
        num_shown: captures with pictures and clouds.
        title: of the page; "" = what the source says of itself.
        progress: told (captures judged, all, which).
        known: what is known of a dataset besides its clouds.

    Raises:
        CaptureError: the source has no captures, or two with one id.
    """
    gathered = gather_captures(
        source, pipeline=pipeline, limits=limits, num_shown=num_shown, title=title, progress=progress, known=known
    )
    return page_of_captures(gathered), gathered.grading


def page_of_captures(gathered: Gathered) -> str:
    """Return the self-contained page that tells what was gathered."""
    grading, looked = gathered.grading, gathered.looked
    scenes = [one.scene for one in looked if one.scene is not None]
    place_of = {scene.name: place for place, scene in enumerate(scenes)}
    sections = [
        Section("Verdict", _verdict(grading)),
        *([Section("Points after each step (median)", bars(funnel_rows(gathered.funnel)))] if gathered.funnel else []),
        *([Section("Left out", _left_out(gathered.left_out))] if gathered.left_out else []),
        Section("Samples", _captures(grading, looked, place_of)),
        Section("Numbers over the samples", _trends(grading)),
        *([Section("Episodes", _episodes(grading))] if grading.episodes else []),
        Section("How this was made", _made(gathered)),
    ]
    return page_of(gathered.title, sections, scenes)


def _verdict(grading: Grading) -> str:
    grade = grading.grade()
    counts = ", ".join(f"{grading.count(verdict):,} {verdict}" for verdict in Verdict if grading.count(verdict))
    total = int((grading.sample_verdicts >= 0).sum())
    parts = [
        f'<p><span class="grade {grade.letter}">{grade.letter}</span>{shown(LETTERS[grade.letter])}. '
        f"Of {total:,} captures: {counts or 'none'}.</p>"
    ]
    for name, finding in grading.together:
        if finding.verdict.severity >= Verdict.WARN.severity:
            parts.append(_finding(finding, grading.name_of(finding.view), f"all captures of {name}"))
    parts += [
        _finding(trend.worst, grading.name_of(trend.view), grading.since_text(trend)) for trend in grading.faults()
    ]
    parts[1:] = sorted(parts[1:], key=lambda part: "finding fail" not in part)  # keeps the order of as bad ones
    if len(parts) == 1:
        parts.append("<p>Nothing that these checks look for is wrong.</p>")
    unknown = sorted({trend.name for trend in grading.trends.values() if trend.verdict is Verdict.UNKNOWN})
    if unknown:
        parts.append(f'<p class="dim">Could not be measured here: {shown(", ".join(unknown))}.</p>')
    return "".join(parts)


def _finding(finding: Finding, view: str, where: str) -> str:
    about = " ".join(filter(None, [finding.name, view]))
    advice = f'<p class="advice">What to do: {shown(finding.advice)}</p>' if finding.advice else ""
    return (
        f'<div class="finding {finding.verdict}"><p><b class="{finding.verdict}">{finding.verdict.value.upper()}</b>'
        f"<b>{shown(about)}</b> {shown(where)}</p><p>{shown(finding.found)}</p>{advice}</div>"
    )


def funnel_rows(steps: Sequence[tuple[str, float]]) -> tuple[tuple[str, float, str], ...]:
    """Return rows for bars from (step, median points after it): each with its share of the step before."""
    rows = []
    for place, (name, count) in enumerate(steps):
        before = steps[place - 1][1] if place else 0
        kept = f" ({count / before:.0%} of before)" if before else ""
        rows.append((f"{place + 1}. {name}", count, f"{count:,.0f}{kept}"))
    return tuple(rows)


def _left_out(left_out: Mapping[str, str]) -> str:
    rows = "".join(
        f"<tr><td>{shown(sample_id, 200)}</td><td>{shown(why, 500)}</td></tr>"
        for sample_id, why in list(left_out.items())[:_MOST_LISTED]
    )
    more = f"<p>{len(left_out) - _MOST_LISTED:,} more.</p>" if len(left_out) > _MOST_LISTED else ""
    return f"<table><tr><th>capture</th><th>why</th></tr>{rows}</table>{more}"


def _captures(grading: Grading, looked: Sequence[Looked], place_of: Mapping[str, int]) -> str:
    parts = []
    numbers = {sample_id: place for place, sample_id in enumerate(grading.ids)}
    for one in looked:
        severity = int(grading.sample_verdicts[numbers[one.sample_id]])
        verdict = list(Verdict)[severity] if severity >= 0 else Verdict.UNKNOWN
        name = shown(one.sample_id, 200)
        if one.sample_id in place_of:
            name = f'<button class="link" data-sample="{place_of[one.sample_id]}">{name}</button>'
        problem = f'<p class="fail">{shown(one.problem)}</p>' if one.problem else ""
        figures = "".join(
            f'<figure><img src="{uri}" alt="{told}" width="220"><figcaption>{told}</figcaption></figure>'
            for told, uri in ((shown(picture.caption), png_uri(picture.png)) for picture in one.pictures)
        )
        parts.append(f'<h3>{name} <span class="{verdict}">{verdict}</span></h3>{problem}{figures}')
    return "".join(parts)


def _trends(grading: Grading) -> str:
    told = told_trends(grading)
    parts = []
    for name, trend in told[:_MOST_TRENDS]:
        values = np.array(trend.values)
        colors = [VERDICT_COLORS[severity] for severity in trend.verdicts]
        chart = (
            time_line(values, colors, limit=trend.worst.threshold)
            if len(values) > 1
            else f"<p>{values[0]:.4g} {shown(trend.worst.unit)}</p>"
        )
        spread = histogram(values, trend.worst.unit) if len(values) > 20 else ""
        parts.append(
            f"<h3>{shown(name)} {f'[{shown(trend.worst.unit)}]' if trend.worst.unit else ''} "
            f'<span class="{trend.verdict}">{trend.verdict}</span></h3><div class="wide">{chart}{spread}</div>'
        )
    if len(told) > _MOST_TRENDS:
        parts.append(f'<p class="dim">{len(told) - _MOST_TRENDS} more are in the JSON of pcdata grade.</p>')
    return "".join(parts) or '<p class="dim">no check measured a number</p>'


def _episodes(grading: Grading) -> str:
    rows = []
    for episode in grading.episodes:
        own = grading.sample_verdicts[episode.first : episode.first + episode.length]
        counts = "".join(f'<td class="number">{int((own == verdict.severity).sum())}</td>' for verdict in Verdict)
        rows.append(f"<tr><td>{shown(episode.id, 120)}</td><td class='number'>{episode.length}</td>{counts}</tr>")
    head = "".join(f"<th>{verdict}</th>" for verdict in Verdict)
    more = f"<p>{len(rows) - 500} more</p>" if len(rows) > 500 else ""
    return f"<table><tr><th>episode</th><th>captures</th>{head}</tr>{''.join(rows[:500])}</table>{more}"


def _made(gathered: Gathered) -> str:
    versions = f"pcdata {__version__}, torch {torch.__version__}, Python {platform.python_version()}"
    steps = f"<pre>{shown(gathered.pipeline, 20_000)}</pre>" if gathered.pipeline else "<p>No pipeline was given.</p>"
    return f"<p>Of {shown(gathered.source)}. {shown(versions)}.</p>{steps}"
