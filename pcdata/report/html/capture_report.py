"""The page on captures: are they good, what is wrong, since when, and what do they look like."""

from __future__ import annotations

from pcdata.io.sources.capture_source import CaptureSource
from pcdata.report.html.gathering import NUM_SHOWN, Gathered, Known, Progress, gather_captures
from pcdata.report.html.page import page_of
from pcdata.report.html.panels.cameras import cameras_panel, overlap_panel, planes_panel
from pcdata.report.html.panels.making import left_out_panel, made_panel
from pcdata.report.html.panels.numbers import funnel_panel, numbers_panel, objects_panel
from pcdata.report.html.panels.over_time import time_panel
from pcdata.report.html.panels.samples import samples_panel
from pcdata.report.html.panels.verdict import verdict_panel
from pcdata.transforms import Compose
from pcdata.validation import CaptureLimits
from pcdata.validation.grading import Grading


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
    """Return the self-contained page that tells what was gathered: the verdict first, how it was made last."""
    scenes = [one.scene for one in gathered.looked if one.scene is not None]
    numbers = {scene.name: number for number, scene in enumerate(scenes)}
    sections = [
        verdict_panel(gathered, numbers),
        cameras_panel(gathered),
        time_panel(gathered),
        funnel_panel(gathered),
        samples_panel(gathered, numbers),
        overlap_panel(gathered),
        planes_panel(gathered),
        objects_panel(gathered),
        numbers_panel(gathered),
        left_out_panel(gathered),
        made_panel(gathered),
    ]
    return page_of(gathered.title, [section for section in sections if section is not None], scenes)
