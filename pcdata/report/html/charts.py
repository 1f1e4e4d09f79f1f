"""Charts as SVG, drawn by hand: a page needs bars and time lines, and no library for them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pcdata.report.html.text import shown

_ROW = 24
VERDICT_COLORS = ("#3ca951", "#9498a0", "#efb118", "#e5484d")  # pass, unknown, warn, fail


def bars(rows: Sequence[tuple[str, float, str]], *, width: int = 720) -> str:  # name, value, what stands beside it
    """Bars from left to right, one below another, all from 0."""
    most = max((value for _, value, _ in rows), default=0) or 1
    left, right = 260, 200
    drawn = []
    for place, (name, value, told) in enumerate(rows):
        y = place * _ROW
        length = (width - left - right) * value / most
        drawn.append(
            f'<text x="{left - 8}" y="{y + 16}" text-anchor="end">{shown(name, 40)}</text>'
            f'<rect x="{left}" y="{y + 4}" width="{length:.1f}" height="16" fill="#4269d0"/>'
            f'<text x="{left + length + 6:.1f}" y="{y + 16}">{shown(told)}</text>'
        )
    return _svg(width, _ROW * len(rows), "".join(drawn))


def histogram(values: NDArray[np.floating], unit: str, *, bins: int = 40, width: int = 340, height: int = 110) -> str:
    """How often numbers come, with the smallest and the largest below."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return '<p class="dim">no numbers</p>'
    counts, edges = np.histogram(finite, bins=bins)
    bar = width / bins
    scale = (height - 20) / max(int(counts.max()), 1)
    drawn = "".join(
        f'<rect x="{place * bar:.1f}" y="{height - 20 - count * scale:.1f}" width="{max(bar - 1, 1):.1f}" '
        f'height="{count * scale:.1f}" fill="#4269d0"/>'
        for place, count in enumerate(counts.tolist())
        if count
    )
    ends = f'<text x="0" y="{height - 4}">{edges[0]:.3g} {shown(unit)}</text>' + (
        f'<text x="{width}" y="{height - 4}" text-anchor="end">{edges[-1]:.3g} {shown(unit)}</text>'
    )
    return _svg(width, height, drawn + ends)


def time_line(
    values: NDArray[np.floating],
    colors: Sequence[str],
    *,
    limit: float | None = None,
    width: int = 720,
    height: int = 70,
) -> str:
    """A number over samples in order, each in its color; the limit as a dashed line, gaps where nothing was measured.

    Of more samples than pixels the worst of each column is kept: its highest color in the order they are given.
    """
    finite = np.isfinite(values)
    inside = [*values[finite].tolist(), *([] if limit is None else [limit])]
    low, high = (min(inside), max(inside)) if inside else (0.0, 1.0)
    span = (high - low) or 1.0

    def across(place: int) -> float:
        return 4 + (width - 8) * (place + 0.5) / max(len(values), 1)

    def down(value: float) -> float:
        return height - 16 - (height - 24) * (value - low) / span

    drawn = []
    if limit is not None:
        drawn.append(
            f'<line x1="0" x2="{width}" y1="{down(limit):.1f}" y2="{down(limit):.1f}" stroke="currentColor" '
            'stroke-dasharray="4 4" opacity=".5"/>'
        )
    for place, value in enumerate(values.tolist()):
        if np.isfinite(value):
            drawn.append(f'<circle cx="{across(place):.1f}" cy="{down(value):.1f}" r="2.2" fill="{colors[place]}"/>')
    drawn.append(f'<text x="0" y="{height - 2}">{low:.3g}</text>')
    drawn.append(f'<text x="{width}" y="{height - 2}" text-anchor="end">{high:.3g}</text>')
    return _svg(width, height, "".join(drawn))


def _svg(width: int, height: int, drawn: str) -> str:
    return (
        f'<svg role="img" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        f'style="max-width:100%">{drawn}</svg>'
    )
