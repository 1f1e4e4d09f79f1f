"""What a page on captures tells, before it is a page: grades, and of some captures pictures, clouds and counts."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from pcdata.datasets.stored_clouds import StoredClouds
from pcdata.errors import PcdataError
from pcdata.io.sources.capture_source import CaptureSource, episodes_of, unread_of
from pcdata.report.html.episode_lines import EpisodeLine, episode_lines
from pcdata.report.html.overlaps import overlap_of
from pcdata.report.html.pictures import WIDTH, color_picture, confidence_picture, depth_picture, edges_picture
from pcdata.report.html.scene import MOST_POINTS, SampleScene, Stage, raw_cloud, stage_of, stages_of
from pcdata.structures import METRE, DepthFrame, PointCloud
from pcdata.threads import core_threads, while_reading
from pcdata.transforms import Compose, Transform, describe_objects
from pcdata.validation import CaptureLimits, validate_source
from pcdata.validation.grading import Grading, Trend
from pcdata.validation.overlap_result import PairOverlap
from pcdata.validation.view_names import view_names
from pcdata.verdicts import Finding, Verdict

NUM_SHOWN = 12  # samples with pictures and clouds, unless more are asked for
_MOST_BYTES = 15 << 20  # of packed clouds in a page; as text, with pictures and the viewer, that is below 30 MB
_MOST_PICTURE_BYTES = 5 << 20
_BYTES_PER_PICTURE = 60_000  # of a color picture of full width
_MOST_VIEWS = 8  # with pictures
_BYTES_PER_POINT = 7  # of a packed point with colors, as measured on captures of Kinect-like sensors
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, kw_only=True)
class Known:
    """What is known of a whole dataset besides its clouds.

    Args:
        findings: about all of it.
        funnel: (step, median points after it) in order.
        left_out: captures that are not in it, and why.
        pipeline: the steps that made it, as YAML.
    """

    findings: tuple[Finding, ...] = ()
    funnel: tuple[tuple[str, float], ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    pipeline: str = ""


@dataclass(frozen=True)
class Picture:
    """A picture of a capture.

    Args:
        caption: what is seen in it.
        png: the file.
    """

    caption: str
    png: bytes


@dataclass(frozen=True)
class Looked:
    """What is shown of one capture.

    Args:
        sample_id: which.
        scene: its clouds, None where there are none.
        pictures: of its depth images.
        funnel: (step, points after it) in order.
        problem: why it cannot be shown.
        pairs: how the surfaces of every two of its views lie on each other.
        objects: (length, width, height) in metres of the box of every object that a step told apart, the largest first;
            None where none did.
    """

    sample_id: str
    scene: SampleScene | None = None
    pictures: tuple[Picture, ...] = ()
    funnel: tuple[tuple[str, int], ...] = ()
    problem: str = ""
    pairs: tuple[PairOverlap, ...] = ()
    objects: tuple[tuple[float, float, float], ...] | None = None


@dataclass(frozen=True, kw_only=True)
class Gathered:
    """All that a page or a picture tells of captures.

    Args:
        title: of the page.
        source: what the source says of itself.
        grading: of every capture.
        looked: the captures that are shown, the worst first.
        funnel: (step, median points after it) in order.
        left_out: captures that are not in the dataset, and why.
        pipeline: the steps as YAML, "" = none.
        lines: some episodes over time, the worst first; a recording without episodes as one.
        unread: what lies beside the captures and is not read, in words.
    """

    title: str
    source: str
    grading: Grading
    looked: tuple[Looked, ...]
    funnel: tuple[tuple[str, float], ...]
    left_out: Mapping[str, str]
    pipeline: str
    lines: tuple[EpisodeLine, ...]
    unread: tuple[str, ...] = ()


def gather_captures(
    source: CaptureSource,
    *,
    pipeline: Compose | None = None,
    limits: CaptureLimits | None = None,
    num_shown: int = NUM_SHOWN,
    title: str = "",
    progress: Progress | None = None,
    known: Known | None = None,
) -> Gathered:
    """Judge every capture of a source, and look at some.

    Captures are judged one at a time; then the worst are looked at, and of the others some from the whole length.

    Args:
        source: anything with ``ids`` and ``load``.
        pipeline: steps to be shown too; its random ones are left out. None = the cloud that each capture shows.
        limits: of the checks; None = the defaults.
        num_shown: captures with pictures and clouds.
        title: of the page; "" = its name, and how many there are.
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
    places = _places_shown(worst, total, num_shown)
    looked = tuple(
        while_reading(
            partial(_opened, source),
            partial(_looked, pipeline=pipeline, num_shown=num_shown),
            places,
            at_once=min(2, core_threads()),
        )
    )
    return Gathered(
        title=title or title_of(source),
        source=str(source),
        grading=grading,
        looked=looked,
        funnel=known.funnel or _funnel(looked),
        left_out=known.left_out,
        pipeline=known.pipeline or (pipeline.to_yaml() if pipeline else ""),
        lines=episode_lines(source, grading),
        unread=tuple(unread_of(source)),
    )


def title_of(source: CaptureSource) -> str:
    """Return what a page calls captures: their name, and how many there are."""
    count = len(source.ids)
    name, what = (source.folder.name, "sample") if isinstance(source, StoredClouds) else (source.name, "capture")
    return f"{name}: {count:,} {what}{'s' * (count != 1)}"


def _places_shown(worst: list[tuple[int, int]], total: int, num_shown: int) -> list[int]:
    """The worst captures first, then others spread over the whole length."""
    bad = [-place for severity, place in sorted(worst, reverse=True) if severity >= Verdict.WARN.severity]
    spread = np.unique(np.linspace(0, total - 1, min(num_shown, total)).round().astype(int)).tolist()
    kept = bad[: max(1, (3 * num_shown) // 4)] if len(bad) < total else spread  # where all are bad none is the worst
    return list(dict.fromkeys([*kept, *spread]))[:num_shown]


def look(
    source: CaptureSource,
    place: int,
    *,
    pipeline: Compose | None = None,
    num_shown: int = 1,
) -> Looked:
    """Return what is shown of one capture of ``num_shown``."""
    return _looked(_opened(source, place), pipeline=pipeline, num_shown=num_shown)


def _opened(source: CaptureSource, place: int) -> tuple[str, DepthFrame | PointCloud | PcdataError]:
    sample_id = source.ids[place]
    try:
        return sample_id, source.load(sample_id)
    except PcdataError as error:
        return sample_id, error


def _looked(
    opened: tuple[str, DepthFrame | PointCloud | PcdataError], *, pipeline: Compose | None, num_shown: int
) -> Looked:
    sample_id, capture = opened
    if isinstance(capture, PcdataError):
        return Looked(sample_id, problem=f"cannot be read: {capture}")
    overlap = overlap_of(capture) if isinstance(capture, DepthFrame) else None
    steps, problem = _steps(capture, pipeline)
    clouds = [(step, data) for step, data in steps if isinstance(data, PointCloud)]
    afterwards = [cloud for _, cloud in reversed(clouds)]
    first = None
    if not clouds or overlap is not None or isinstance(capture, PointCloud):
        try:
            first = capture if isinstance(capture, PointCloud) else raw_cloud(capture)
        except PcdataError as error:
            problem = problem or str(error)

    def stages_within(most_points: int) -> tuple[Stage, ...]:
        each = max(2000, most_points // max(len(clouds) + (first is not None), 1))
        stages = stages_of(clouds, most_points=each)
        if first is None:
            return stages
        shown = first if overlap is None else overlap.shown_on(first, each)
        told = "cloud" if isinstance(capture, PointCloud) else "capture"
        return (stage_of(told, shown, most_points=each, total=first.num_points), *stages)

    most_bytes = _MOST_BYTES // max(num_shown, 1)
    most_points = min(2 * MOST_POINTS, most_bytes // _BYTES_PER_POINT)
    stages = stages_within(most_points)
    size = sum(len(stage.cloud.content) for stage in stages)
    if size > most_bytes:  # points of many fields
        stages = stages_within(int(0.95 * most_points * most_bytes / size))
    return Looked(
        sample_id,
        scene=SampleScene(sample_id, stages) if stages else None,
        pictures=tuple(_pictures(capture, num_shown)) if isinstance(capture, DepthFrame) else (),
        funnel=tuple((type(step).__name__, cloud.num_points) for step, cloud in clouds),
        problem=problem,
        pairs=() if overlap is None else overlap.pairs,
        objects=next((own for one in (*afterwards, capture) if (own := _boxes(one)) is not None), None),
    )


def _steps(capture: DepthFrame | PointCloud, pipeline: Compose | None) -> tuple[list[tuple[Transform, Any]], str]:
    """Return what every step of a pipeline left, and why it could not be gone through."""
    if pipeline is None:
        return [], ""
    try:
        return list(pipeline.split()[0].step_through(capture)), ""
    except PcdataError as error:
        return [], "; ".join([str(error), *getattr(error, "__notes__", ())])


def _boxes(data: DepthFrame | PointCloud) -> tuple[tuple[float, float, float], ...] | None:
    """Return the sizes of the boxes of a cloud's objects; None where no step told objects apart on a plane."""
    if not isinstance(data, PointCloud) or data.num_clouds != 1 or "objects" not in data.meta[0]:
        return None
    if data.labels is None or not data.meta[0].get("planes") or data.unit != METRE:
        return None
    sizes = [one.size.tolist() for one in describe_objects(data)]
    return tuple((x, y, z) for x, y, z in sorted(sizes, reverse=True))


def _pictures(frame: DepthFrame, num_shown: int) -> Iterator[Picture]:
    names = view_names(frame.provenance, frame.num_views)
    count = num_shown * min(frame.num_views, _MOST_VIEWS) * (1 + (frame.colors is not None))
    width = int(WIDTH * min(1.0, _MOST_PICTURE_BYTES / (_BYTES_PER_PICTURE * count)) ** 0.5)
    for view in range(min(frame.num_views, _MOST_VIEWS)):
        depth = frame.depth[view]
        valid = depth > 0
        near, far = (float(depth[valid].min()), float(depth[valid].max())) if bool(valid.any()) else (0.0, 0.0)
        share = float(valid.float().mean())
        caption = f"{names[view]}: depth {near:.2f} to {far:.2f} m, {share:.1%} of pixels read (magenta: none)"
        yield Picture(caption, depth_picture(frame, view, width))
        if (edges := edges_picture(frame, view, width)) is not None:
            yield Picture(f"{names[view]}: rims of depth (red) over color", edges)
        if (confidence := confidence_picture(frame, view, width)) is not None:
            yield Picture(f"{names[view]}: confidence", confidence)
    if frame.num_views > _MOST_VIEWS:
        picture = color_picture(frame, _MOST_VIEWS, width) or depth_picture(frame, _MOST_VIEWS, width)
        yield Picture(f"{frame.num_views - _MOST_VIEWS} views more are not shown", picture)


def _funnel(looked: Sequence[Looked]) -> tuple[tuple[str, float], ...]:
    """The median points after each step of the samples that are shown."""
    chains = [one.funnel for one in looked if one.funnel]
    if not chains:
        return ()
    names = [name for name, _ in chains[0]]
    same = [chain for chain in chains if [name for name, _ in chain] == names]
    medians = np.median(np.array([[count for _, count in chain] for chain in same]), axis=0).tolist()
    return tuple(zip(names, medians))


def told_trends(grading: Grading) -> list[tuple[str, Trend]]:
    """Return the trends that have numbers, with the check and the view that each is of, the worst first."""
    told = [trend for trend in grading.trends.values() if np.isfinite(np.array(trend.values)).any()]
    ranked = sorted(told, key=lambda trend: -trend.verdict.severity)
    return [(" ".join(filter(None, [trend.name, grading.name_of(trend.view)])), trend) for trend in ranked]
