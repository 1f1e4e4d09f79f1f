"""Charts as SVG, drawn by hand: a page needs bars and time lines, and no library for them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pcdata.report.html.text import shown
from pcdata.verdicts import in_figures

VERDICT_COLORS = ("#3ca951", "#9498a0", "#efb118", "#e5484d")  # pass, unknown, warn, fail
_SERIES_COLORS = ("#4269d0", "#efb118", "#ff725c", "#3ca951", "#a463f2", "#6cc5b0", "#ff8ab7", "#9c6b4e")


def bars(rows: Sequence[tuple[str, float, str]]) -> str:  # name, value, what stands beside it
    """Bars from left to right, one below another, all from 0; as wide as the page."""
    most = max((value for _, value, _ in rows), default=0) or 1
    drawn = [
        f"<span>{shown(name, 60)}</span><span>{shown(told)}</span>"
        f'<span class="bar-track"><i style="width:{100 * value / most:.1f}%"></i></span>'
        for name, value, told in rows
    ]
    return f'<div class="bars">{"".join(drawn)}</div>'


def histogram(values: NDArray[np.floating], unit: str, *, bins: int = 40, width: int = 340, height: int = 110) -> str:
    """How often numbers come, with the smallest and the largest below."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return '<p class="dim">no numbers</p>'
    counts, edges = np.histogram(finite, bins=bins)
    ends = f'<text x="0" y="{height - 4}">{in_figures(edges[0])} {shown(unit)}</text>' + (
        f'<text x="{width}" y="{height - 4}" text-anchor="end">{in_figures(edges[-1])} {shown(unit)}</text>'
    )
    return _svg(width, height, _columns(counts, width, height - 20) + ends)


def bins(counts: NDArray[np.integer], *, width: int = 160, height: int = 28) -> str:
    """A small histogram of counts that are known."""
    return _svg(width, height, _columns(counts, width, height))


def _columns(counts: NDArray[np.integer], width: int, height: int) -> str:
    bar = width / max(len(counts), 1)
    scale = height / max(int(counts.max(initial=0)), 1)
    return "".join(
        f'<rect x="{place * bar:.1f}" y="{height - count * scale:.1f}" width="{max(bar - 1, 1):.1f}" '
        f'height="{count * scale:.1f}" fill="#4269d0"/>'
        for place, count in enumerate(counts.tolist())
        if count
    )


def time_line(
    values: NDArray[np.floating],
    severities: Sequence[int],  # 0 = pass to 3 = fail
    *,
    limit: float | None = None,
    width: int = 720,
    height: int = 60,
) -> str:
    """A number over samples in order, in the colors of verdicts; the limit as a dashed line.

    Of many more samples than pixels the lowest, the highest and the worst of each column of pixels are drawn.
    """
    finite = np.isfinite(values)
    inside = [*values[finite].tolist(), *([] if limit is None else [limit])]
    low, high = (min(inside), max(inside)) if inside else (0.0, 1.0)
    span = (high - low) or 1.0

    def down(value: float) -> float:
        return height - 4 - (height - 8) * (value - low) / span

    drawn = []
    if limit is not None:
        y = down(limit)
        drawn.append(
            f'<path d="M0 {y:.1f}H{width}" stroke="currentColor" stroke-dasharray="4 4" opacity=".5" '
            'vector-effect="non-scaling-stroke"/>'
        )
    for place in _some_of(values, width, severities).tolist():
        if finite[place]:
            across = 4 + (width - 8) * (place + 0.5) / len(values)
            drawn.append(_dot(across, down(values[place]), VERDICT_COLORS[severities[place]]))
    return _stretched(width, height, "".join(drawn))


def strip(
    severities: NDArray[np.integer],  # (N,) of each sample in order, 0 = pass to 3 = fail, -1 = none
    *,
    gaps: Sequence[int] = (),
    width: int = 720,
) -> str:
    """Verdicts over samples in order as one colored band, the worst of each column; gaps as dark marks above it."""
    count, worst = len(severities), worst_of_columns(severities, width)
    columns = len(worst)
    edges = [0, *(np.flatnonzero(np.diff(worst)) + 1).tolist(), columns] if columns else [0]
    drawn = []
    for start, stop in itertools.pairwise(edges):
        x, end = (width * edge / columns for edge in (start, stop))
        color = VERDICT_COLORS[worst[start]] if worst[start] >= 0 else "transparent"
        drawn.append(f'<rect x="{x:.1f}" y="6" width="{end - x:.1f}" height="14" fill="{color}"/>')
    for place in gaps:
        x = width * place / max(count, 1)
        drawn.append(f'<path d="M{x - 4:.1f} 0h8l-4 6z" fill="currentColor"/>')
    return _stretched(width, 20, "".join(drawn))


def worst_of_columns(severities: NDArray[np.integer], most: int) -> NDArray[np.int64]:
    """Return the worst of each of up to ``most`` runs of as many samples, in order."""
    count = len(severities)
    columns = min(count, most)
    worst = np.full(columns, -1, dtype=np.int64)
    np.maximum.at(worst, np.arange(count) * columns // max(count, 1), severities)
    return worst


def verdict_legend() -> str:
    """Say what the colors of verdicts mean."""
    told = zip(VERDICT_COLORS, ("pass", "could not be measured", "warn", "fail"))
    entries = "".join(f'<span><i style="background:{color}"></i>{name}</span>' for color, name in told)
    return f'<p class="legend">{entries}</p>'


def curves(
    series: Mapping[str, NDArray[np.floating]],  # name -> (N,) over the same samples in order, NaN = none
    unit: str,
    *,
    width: int = 720,
    height: int = 90,
) -> str:
    """Several numbers over samples in order, each in its color, in one chart with one scale."""
    finite = [values[np.isfinite(values)] for values in series.values()]
    if not any(map(len, finite)):
        return '<p class="dim">no numbers</p>'
    low, high = min(float(v.min()) for v in finite if len(v)), max(float(v.max()) for v in finite if len(v))
    span = (high - low) or 1.0
    drawn, legend = [], []
    for number, (name, values) in enumerate(series.items()):
        color = _SERIES_COLORS[number % len(_SERIES_COLORS)]
        places = _some_of(values, width)
        across = 4 + (width - 8) * (places + 0.5) / max(len(values), 1)
        down = height - 4 - (height - 8) * (values[places] - low) / span
        drawn.append(_curve(across, down, color))
        legend.append(f'<span><i style="background:{color}"></i>{shown(name, 80)}</span>')
    told = f"<span>{in_figures(low)} to {in_figures(high)} {shown(unit)}</span>"
    named = "".join(legend) if len(series) > 1 else ""
    return f'{_stretched(width, height, "".join(drawn))}<p class="legend">{told}{named}</p>'


def _curve(across: NDArray[np.floating], down: NDArray[np.floating], color: str) -> str:
    """One line, broken where there is no number; what stands alone is a dot."""
    there = np.isfinite(down)
    starts = np.flatnonzero(there & ~np.concatenate([[False], there[:-1]]))
    stops = np.flatnonzero(there & ~np.concatenate([there[1:], [False]])) + 1
    drawn = []
    for start, stop in zip(starts.tolist(), stops.tolist()):
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across[start:stop], down[start:stop]))
        if stop - start == 1:
            drawn.append(_dot(across[start], down[start], color))
        else:
            drawn.append(
                f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="1.6" '
                'vector-effect="non-scaling-stroke"/>'
            )
    return "".join(drawn)


def _some_of(
    values: NDArray[np.floating], columns: int, severities: Sequence[int] | None = None
) -> NDArray[np.int64]:  # rising
    """Return which samples are drawn: all, or of each column of pixels the lowest, the highest and the worst."""
    count = len(values)
    if count <= 2 * columns:
        return np.arange(count)
    column = np.arange(count) * columns // count
    ranks = [values, -values, *([] if severities is None else [-np.asarray(severities, dtype=np.float64)])]
    kept = []
    for rank in ranks:
        order = np.lexsort([np.where(np.isfinite(rank), rank, np.inf), column])
        kept.append(order[np.searchsorted(column[order], np.arange(columns))])
    return np.unique(np.concatenate(kept))


def _dot(across: float, down: float, color: str) -> str:
    """A dot that stays round however wide its chart is stretched: a line of no length with round ends."""
    return (
        f'<path d="M{across:.1f} {down:.1f}h0" stroke="{color}" stroke-width="4.4" stroke-linecap="round" '
        'vector-effect="non-scaling-stroke"/>'
    )


def _stretched(width: int, height: int, drawn: str) -> str:
    """A chart as wide as there is room, up to ``width``; it has no text, which would be stretched too."""
    return (
        f'<svg role="img" class="stretched" viewBox="0 0 {width} {height}" preserveAspectRatio="none" '
        f'style="height:{height}px">{drawn}</svg>'
    )


def _svg(width: int, height: int, drawn: str) -> str:
    return f'<svg role="img" width="{width}" height="{height}" viewBox="0 0 {width} {height}">{drawn}</svg>'
