"""The page on captures: are they good, what is wrong, since when, and what do they look like."""

from __future__ import annotations

import heapq
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from pcdata import __version__
from pcdata.errors import PcdataError
from pcdata.io.sources.capture_source import CaptureSource, episodes_of
from pcdata.report.html.charts import VERDICT_COLORS, bars, histogram, time_line
from pcdata.report.html.page import Section, page_of
from pcdata.report.html.pictures import color_picture, confidence_picture, depth_picture, edges_picture
from pcdata.report.html.scene import MOST_POINTS, SampleScene, Stage, raw_cloud, stage_of, stages_of
from pcdata.report.html.text import shown
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms import Compose
from pcdata.validation import CaptureLimits, validate_source
from pcdata.validation.grading import LETTERS, Grading
from pcdata.validation.view_names import view_names
from pcdata.verdicts import Finding, Verdict

NUM_SHOWN = 12  # samples with pictures and clouds, unless more are asked for
_MOST_BYTES = 18 << 20  # of packed clouds in a page; as text, with pictures, that is below 30 MB
_BYTES_PER_POINT = 7  # of a packed point with colors, as measured on captures of Kinect-like sensors
_MOST_TRENDS = 24  # time lines
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, kw_only=True)
class Known:
    """What is known of a whole dataset besides its clouds.

    Args:
        findings: about all of it.
        funnel: (step, median points after it, words) in order.
        sections: parts of the page of its own.
        pipeline: the steps that made it, as YAML.
    """

    findings: tuple[Finding, ...] = ()
    funnel: tuple[tuple[str, float, str], ...] = ()
    sections: tuple[Section, ...] = ()
    pipeline: str = ""


@dataclass(frozen=True)
class _Looked:
    """What is shown of one capture."""

    sample_id: str
    scene: SampleScene | None
    pictures: tuple[tuple[str, str], ...]  # caption, data URI
    funnel: tuple[tuple[str, int], ...]  # step, points after it
    problem: str = ""  # why it cannot be shown


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

    Captures are judged one at a time; then the worst are shown, and of the others some from the whole length.

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
    known = known or Known()
    grading = Grading(source.ids, episodes_of(source))
    grading.together += [("the build", finding) for finding in known.findings]
    worst: list[tuple[int, int]] = []  # (severity, -place) of the worst captures
    total = len(source.ids)
    for report in validate_source(source, limits=limits):
        grading.add(report)
        if not report.whole:
            place = int((grading.sample_verdicts >= 0).sum()) - 1
            entry = (report.verdict.severity, -place)
            (heapq.heappush if len(worst) < num_shown else heapq.heappushpop)(worst, entry)
            if progress is not None:
                progress(place + 1, total, report.sample_id)
    looked = [_look(source, place, pipeline, num_shown, grading) for place in _places_shown(worst, total, num_shown)]
    return _page(source, grading, looked, pipeline, title or str(source), known), grading


def _places_shown(worst: list[tuple[int, int]], total: int, num_shown: int) -> list[int]:
    """The worst captures first, then others spread over the whole length."""
    bad = [-place for severity, place in sorted(worst, reverse=True) if severity >= Verdict.WARN.severity]
    spread = np.unique(np.linspace(0, total - 1, min(num_shown, total)).round().astype(int)).tolist()
    kept = bad[: max(1, (3 * num_shown) // 4)] if len(bad) < total else spread  # where all are bad none is the worst
    return list(dict.fromkeys([*kept, *spread]))[:num_shown]


def _look(source: CaptureSource, place: int, pipeline: Compose | None, num_shown: int, grading: Grading) -> _Looked:
    sample_id = source.ids[place]
    most_points = min(2 * MOST_POINTS, _MOST_BYTES // (_BYTES_PER_POINT * max(num_shown, 1)))
    try:
        capture = source.load(sample_id)
        if isinstance(capture, DepthFrame) and not grading.names:
            grading.names = view_names(capture.provenance, capture.num_views)
    except PcdataError as error:
        return _Looked(sample_id, None, (), (), f"cannot be read: {error}")
    pictures = tuple(_pictures(capture)) if isinstance(capture, DepthFrame) else ()
    stages, funnel, problem = _stages(capture, pipeline, most_points)
    return _Looked(sample_id, SampleScene(sample_id, stages) if stages else None, pictures, funnel, problem)


def _stages(
    capture: DepthFrame | PointCloud, pipeline: Compose | None, most_points: int
) -> tuple[tuple[Stage, ...], tuple[tuple[str, int], ...], str]:
    """Return the clouds after the steps, the points of each, and why there are none; then the capture is shown."""
    problem = ""
    if pipeline is not None:
        try:
            steps = list(pipeline.split()[0].step_through(capture))
            funnel = tuple(
                (type(step).__name__, data.num_points) for step, data in steps if isinstance(data, PointCloud)
            )
            return stages_of(steps, most_points=most_points), funnel, ""
        except PcdataError as error:
            problem = "; ".join([str(error), *getattr(error, "__notes__", ())])
    try:
        cloud = capture if isinstance(capture, PointCloud) else raw_cloud(capture)
        return (stage_of("capture", cloud, most_points=min(most_points, MOST_POINTS)),), (), problem
    except PcdataError as error:
        return (), (), problem or str(error)


def _pictures(frame: DepthFrame) -> Iterator[tuple[str, str]]:
    names = view_names(frame.provenance, frame.num_views)
    for view in range(min(frame.num_views, 8)):
        depth = frame.depth[view]
        valid = depth > 0
        near, far = (float(depth[valid].min()), float(depth[valid].max())) if bool(valid.any()) else (0.0, 0.0)
        share = float(valid.float().mean())
        caption = f"{names[view]}: depth {near:.2f} to {far:.2f} m, {share:.1%} of pixels read (magenta: none)"
        yield caption, depth_picture(frame, view)
        if (edges := edges_picture(frame, view)) is not None:
            yield f"{names[view]}: rims of depth (red) over color", edges
        if (confidence := confidence_picture(frame, view)) is not None:
            yield f"{names[view]}: confidence", confidence
    if frame.num_views > 8:
        yield f"{frame.num_views - 8} views more are not shown", color_picture(frame, 8) or depth_picture(frame, 8)


def _page(
    source: CaptureSource, grading: Grading, looked: list[_Looked], pipeline: Compose | None, title: str, known: Known
) -> str:
    scenes = [one.scene for one in looked if one.scene is not None]
    place_of = {scene.name: place for place, scene in enumerate(scenes)}
    funnel = known.funnel or _funnel(looked)
    sections = [
        Section("Verdict", _verdict(grading)),
        *([Section("Points after each step (median)", bars(funnel))] if funnel else []),
        *known.sections,
        Section("Samples", _captures(grading, looked, place_of)),
        Section("Numbers over the samples", _trends(grading)),
        *([Section("Episodes", _episodes(grading))] if grading.episodes else []),
        Section("How this was made", _made(source, known.pipeline or (pipeline.to_yaml() if pipeline else ""))),
    ]
    return page_of(title, sections, scenes)


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


def _funnel(looked: list[_Looked]) -> tuple[tuple[str, float, str], ...]:
    """The median points after each step of the samples that are shown."""
    chains = [one.funnel for one in looked if one.funnel]
    if not chains:
        return ()
    names = [name for name, _ in chains[0]]
    same = [chain for chain in chains if [name for name, _ in chain] == names]
    medians = np.median(np.array([[count for _, count in chain] for chain in same]), axis=0).tolist()
    return funnel_rows(list(zip(names, medians)))


def funnel_rows(steps: Sequence[tuple[str, float]]) -> tuple[tuple[str, float, str], ...]:
    """Return rows for bars from (step, median points after it): each with its share of the step before."""
    rows = []
    for place, (name, count) in enumerate(steps):
        before = steps[place - 1][1] if place else 0
        kept = f" ({count / before:.0%} of before)" if before else ""
        rows.append((f"{place + 1}. {name}", count, f"{count:,.0f}{kept}"))
    return tuple(rows)


def _captures(grading: Grading, looked: list[_Looked], place_of: Mapping[str, int]) -> str:
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
            for told, uri in ((shown(caption), uri) for caption, uri in one.pictures)
        )
        parts.append(f'<h3>{name} <span class="{verdict}">{verdict}</span></h3>{problem}{figures}')
    return "".join(parts)


def _trends(grading: Grading) -> str:
    def rank(trend: Any) -> tuple[int, int]:
        return -trend.verdict.severity, 0

    told = [trend for trend in grading.trends.values() if np.isfinite(np.array(trend.values)).any()]
    parts = []
    for trend in sorted(told, key=rank)[:_MOST_TRENDS]:
        values = np.array(trend.values)
        colors = [VERDICT_COLORS[severity] for severity in trend.verdicts]
        name = " ".join(filter(None, [trend.name, grading.name_of(trend.view)]))
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


def _made(source: CaptureSource, pipeline: str) -> str:
    versions = f"pcdata {__version__}, torch {torch.__version__}, Python {platform.python_version()}"
    steps = f"<pre>{shown(pipeline, 20_000)}</pre>" if pipeline else "<p>No pipeline was given.</p>"
    return f"<p>Of {shown(source)}. {shown(versions)}.</p>{steps}"
