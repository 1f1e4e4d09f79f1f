"""The page on drift: where every camera was over a recording."""

from __future__ import annotations

import numpy as np

from pcdata.report.html.charts import time_line
from pcdata.report.html.page import Section, page_of
from pcdata.report.html.text import shown
from pcdata.validation.drift_result import MOVING, CameraDrift, DriftResult


def drift_page(result: DriftResult, title: str) -> str:
    """Return a self-contained page: the verdict of every camera, then its way over the recording."""
    advice = f'<p class="advice">What to do: {shown(result.advice)}</p>' if result.advice else ""
    told = "".join(
        f'<div class="finding {camera.verdict}"><p><b class="{camera.verdict}">{camera.verdict.value.upper()}</b>'
        f"<b>{shown(camera.name)}</b> {shown(camera.told)}</p></div>"
        for camera in sorted(result.cameras, key=lambda camera: -camera.verdict.severity)
    )
    sections = [Section("Verdict", told + advice)]
    sections += [Section(camera.name, _way(camera, result)) for camera in result.cameras if camera.kind != MOVING]
    return page_of(title, sections, [])


def _way(camera: CameraDrift, result: DriftResult) -> str:
    limits = result.limits
    severities = [point.verdict.severity for point in camera.points]
    shifts = np.array([1e3 * point.shift for point in camera.points])
    turns = np.array([point.rotation_degrees for point in camera.points])
    first, last = camera.points[0].first, camera.points[-1].last
    unknown = f"<p>Not measurable: {shown('; '.join(camera.unmeasurable))}.</p>" if camera.unmeasurable else ""
    return (
        f"<p>{shown(first)} to {shown(last)}, {len(camera.points)} windows.</p>"
        f"<h3>Shift of what it sees [mm]</h3>{time_line(shifts, severities, limit=1e3 * limits.shift[0])}"
        f"<h3>Rotation [degrees]</h3>{time_line(turns, severities, limit=limits.rotation_degrees[0])}{unknown}"
    )
