"""The page on captures: are they good, what is wrong, since when, and what do they look like."""

from __future__ import annotations

from pcdata.report.html.gathering import Gathered
from pcdata.report.html.page import page_of
from pcdata.report.html.panels.cameras import cameras_panel, overlap_panel, planes_panel
from pcdata.report.html.panels.making import left_out_panel, made_panel
from pcdata.report.html.panels.numbers import funnel_panel, numbers_panel, objects_panel
from pcdata.report.html.panels.over_time import time_panel
from pcdata.report.html.panels.samples import samples_panel
from pcdata.report.html.panels.verdict import verdict_panel


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
