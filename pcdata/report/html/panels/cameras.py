"""Which camera went wrong, and since when; how the surfaces of every two lie on each other; planes and noise."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pcdata.report.html.charts import bins, curves, strip, verdict_legend
from pcdata.report.html.gathering import Gathered
from pcdata.report.html.page import Section
from pcdata.report.html.pair_gaps import PairGap, pair_gaps
from pcdata.report.html.text import shown
from pcdata.validation.by_camera import CameraHistory, cameras_of
from pcdata.validation.grading import Grading
from pcdata.verdicts import in_figures

PLANES = (  # finding, heading, unit that is shown, of it in one of the finding's
    ("plane_noise", "Noise: scatter of readings on the largest plane", "mm", 1e3),
    ("plane_height", "Height of the largest plane", "mm", 1e3),
    ("plane_tilt", "Tilt of the largest plane", "degrees", 1.0),
)


def cameras_panel(gathered: Gathered) -> Section | None:
    """One band over the captures for every camera, and since when it is at its worst."""
    histories = cameras_of(gathered.grading)
    if not histories or len(gathered.grading.ids) < 2:
        return None
    first, last = gathered.grading.ids[0], gathered.grading.ids[-1]
    ends = f'<p class="ends"><span>{shown(first, 60)}</span><span>{shown(last, 60)}</span></p>'
    return Section("Cameras over the captures", "".join(map(_history, histories)) + ends + verdict_legend())


def _history(camera: CameraHistory) -> str:
    checks = ", ".join(dict.fromkeys(fault.name for fault in camera.faults))
    since = f"{shown(camera.since)}: {shown(checks)}" if camera.faults else ""
    verdict = f'<span class="{camera.verdict}">{camera.verdict}</span>'
    return f'<p class="row"><b>{shown(camera.name, 120)}</b> {verdict} {since}</p>{strip(camera.severities)}'


def overlap_panel(gathered: Gathered) -> Section | None:
    """The gaps between the surfaces of every two cameras, over the captures that are shown."""
    rows = [_pair_row(gap) for gap in pair_gaps(pair for one in gathered.looked for pair in one.pairs)]
    if not rows:
        return None
    head = (
        "<tr><th>cameras</th><th>half of the surface within</th><th>90 % within</th><th>shared</th>"
        "<th>signed gap, -15 to 15 mm</th></tr>"
    )
    note = (
        '<p class="dim">Medians over the captures that are shown. In three dimensions color by '
        "gap_between_cameras_mm to see where. A camera that slid along a table leaves these gaps small: view_pose "
        "tells.</p>"
    )
    return Section("Overlap of cameras", f'<div class="wide"><table>{head}{"".join(rows)}</table></div>{note}')


def _pair_row(gap: PairGap) -> str:
    shared = f"{100 * gap.shared:.0f} %"
    if math.isnan(gap.half):
        told = f'<td colspan="2">too little is shared</td><td class="number">{shared}</td><td></td>'
    else:
        half, most = 1e3 * gap.half, 1e3 * gap.most
        told = (
            f'<td class="number {gap.verdict}">{half:.1f} mm</td><td class="number">{most:.1f} mm</td>'
            f'<td class="number">{shared}</td><td>{bins(gap.counts)}</td>'
        )
    return f"<tr><td>{shown(gap.first, 80)} - {shown(gap.second, 80)}</td>{told}</tr>"


def planes_panel(gathered: Gathered) -> Section | None:
    """Noise, height and tilt of the largest plane of every camera over the captures."""
    parts = [*_plane_parts(gathered.grading)]
    if not parts:
        return None
    note = (
        '<p class="dim">A table stays where it is: a step is a moved table or a moved camera. '
        "Of cameras without poses the distance and the tilt against the image are told.</p>"
    )
    return Section("Planes and noise", "".join(parts) + note)


def _plane_parts(grading: Grading) -> Iterator[str]:
    for name, heading, unit, factor in PLANES:
        series = {view: factor * values for view, values in series_of(grading, name).items()}
        if not series:
            continue
        medians = {view: in_figures(float(np.nanmedian(values))) for view, values in series.items()}
        middles = ", ".join(f"{shown(view, 60)} {middle}" for view, middle in medians.items())
        chart = curves(series, unit) if len(grading.ids) > 1 else ""
        yield f"<h3>{heading}</h3><p>Median [{unit}]: {middles}</p>{chart}"


def series_of(grading: Grading, name: str) -> dict[str, NDArray[np.float64]]:
    """Return the numbers of a check over all captures by camera; NaN where it measured nothing."""
    found = {}
    for trend in grading.trends.values():
        if trend.name == name and np.isfinite(np.array(trend.values)).any():
            values = np.full(len(grading.ids), np.nan)
            values[np.array(trend.places)] = np.array(trend.values)
            found[grading.name_of(trend.view) or name] = values
    return found
