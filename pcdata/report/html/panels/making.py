"""How the page was made: of which captures, by which versions and steps; and what was left out."""

from __future__ import annotations

import platform

import torch

from pcdata import __version__
from pcdata.report.html.gathering import Gathered
from pcdata.report.html.page import Section
from pcdata.report.html.text import shown

_MOST_LISTED = 200  # captures that were left out


def left_out_panel(gathered: Gathered) -> Section | None:
    """Captures that are not in the dataset, and why."""
    if not gathered.left_out:
        return None
    rows = "".join(
        f"<tr><td>{shown(sample_id, 200)}</td><td>{shown(why, 500)}</td></tr>"
        for sample_id, why in list(gathered.left_out.items())[:_MOST_LISTED]
    )
    left = len(gathered.left_out) - _MOST_LISTED
    more = f"<p>{left:,} more.</p>" if left > 0 else ""
    return Section("Left out", f"<table><tr><th>capture</th><th>why</th></tr>{rows}</table>{more}")


def made_panel(gathered: Gathered) -> Section:
    """The source, the versions and the steps."""
    versions = f"pcdata {__version__}, torch {torch.__version__}, Python {platform.python_version()}"
    steps = (
        "<details><summary>the steps, with all their fields</summary>"
        f"<pre>{shown(gathered.pipeline, 20_000)}</pre></details>"
        if gathered.pipeline
        else "<p>No pipeline was given; --config FILE.yaml shows what its steps leave.</p>"
    )
    return Section("How this was made", f"<p>Of {shown(gathered.source)}. {shown(versions)}.</p>{steps}")
