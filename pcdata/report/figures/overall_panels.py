"""Panels on all captures together: bands of verdicts, gaps between cameras, numbers over time, objects."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.report.figures.coloring import PALETTE
from pcdata.report.html.charts import VERDICT_COLORS, worst_of_columns
from pcdata.report.html.pair_gaps import PairGap
from pcdata.report.labels import label_text

_COLUMNS = 720  # of a band: the worst of each is drawn
_MOST_CURVES = 12
_NAME_WIDTH = 0.85  # inches of a sample's name below an axis
_NONE = (0, 0, 0, 0)  # clear: no verdict


@dataclass(frozen=True, eq=False)
class Band:
    """One row of a panel: verdicts over captures in order.

    Args:
        name: of what is judged.
        told: stands beside the name.
        severities: (N,) of each capture, 0 = pass to 3 = fail, -1 = none.
        gaps: places before which captures are missing.
    """

    name: str
    told: str
    severities: NDArray[np.integer]
    gaps: Sequence[int] = ()


def bands_panel(axis: Any, title: str, bands: Sequence[Band], ends: tuple[str, str] | None = None) -> None:
    """Draw verdicts over captures as colored bands, one below another, captures that are missing as marks above."""
    from matplotlib.colors import to_rgba

    colors = np.array([*map(to_rgba, VERDICT_COLORS), _NONE])  # -1 is the last
    axis.set_title(label_text(title), fontsize=12)
    for row, band in enumerate(bands):
        image = colors[worst_of_columns(band.severities, _COLUMNS)][None]
        axis.imshow(image, extent=(0, 1, row + 0.4, row), aspect="auto", interpolation="nearest")
        told = label_text(_short(f"{_short(band.name, 30)}  {band.told}", 76))
        axis.text(0, row - 0.08, told, va="bottom", fontsize=10).set_in_layout(False)
        across = [place / max(len(band.severities), 1) for place in band.gaps]
        if across:
            axis.plot(across, [row - 0.05] * len(across), "v", color="black", markersize=4)
    for verdict, color in zip(("pass", "could not be measured", "warn", "fail"), VERDICT_COLORS):
        axis.plot([], [], "s", color=color, markersize=5, label=verdict)
    if any(band.gaps for band in bands):
        axis.plot([], [], "v", color="black", markersize=4, label="captures are missing")
    for end, edge, side in zip(ends or (), (0, 1), ("left", "right")):
        told = label_text(_short(end, 24))
        axis.text(edge, len(bands) - 0.55, told, ha=side, va="top", fontsize=9).set_in_layout(False)
    axis.set_xlim(0, 1)
    axis.set_ylim(max(len(bands), 3) + 0.3, -0.6)
    axis.set_axis_off()
    axis.legend(
        loc="lower left", ncols=5, fontsize=9, frameon=False, borderaxespad=0, handletextpad=0.2, columnspacing=1
    ).set_in_layout(False)


def curves_panel(
    axis: Any,
    title: str,
    series: Mapping[str, NDArray[np.floating]],  # name -> (N,), NaN = none
    places: NDArray[np.integer] | None = None,  # (N,) where on the axis; None = 0 to N - 1
) -> None:
    """Draw numbers over captures in order, each in its color, broken where nothing was measured."""
    axis.set_title(label_text(_short(title)), fontsize=9)
    for number, (name, values) in enumerate([*series.items()][:_MOST_CURVES]):
        there = np.concatenate([[False], np.isfinite(values), [False]])
        alone = there[1:-1] & ~there[:-2] & ~there[2:]  # no line joins it
        axis.plot(
            np.arange(len(values)) if places is None else places,
            values,
            color=PALETTE[number % len(PALETTE)],
            linewidth=1.2,
            marker="o",
            markersize=3,
            markevery=np.flatnonzero(alone).tolist(),
            label=label_text(_short(name, 40)),
        )
    more = f"and {len(series) - _MOST_CURVES} more" if len(series) > _MOST_CURVES else None
    columns = 1 if len(series) <= 4 else 2
    legend = axis.legend(loc="upper left", ncols=columns, fontsize=6, frameon=False, title=more, title_fontsize=6)
    for handle in legend.legend_handles:
        handle.set_marker("")
    low, high = axis.get_ylim()
    room = 0.06 * (-(-min(len(series), _MOST_CURVES) // columns) + bool(more))
    axis.set_ylim(low, low + (high - low) / (1 - room))  # the names stand above the curves
    axis.set_xlabel("capture", fontsize=7)
    _plain(axis)
    axis.xaxis.get_major_locator().set_params(integer=True)


def gap_panel(axis: Any, gap: PairGap) -> None:
    """Draw how often the surfaces of two cameras lie how far apart, in the color of the verdict."""
    color = VERDICT_COLORS[gap.verdict.severity]
    names = f"{_short(gap.first, 28)} - {_short(gap.second, 28)}"
    axis.set_title(f"{label_text(names)}\n{_gap_text(gap)}", fontsize=7.5)
    edges = np.linspace(-15, 15, len(gap.counts) + 1)
    axis.stairs(gap.counts, edges, fill=True, color=color)
    axis.axvline(0, linewidth=0.6, color="#6b6b66")
    axis.set_xlim(-15, 15)
    axis.set_xlabel("signed gap [mm]", fontsize=7)
    _plain(axis)
    axis.set_yticks([])


def _gap_text(gap: PairGap) -> str:
    shared = f"{100 * gap.shared:.0f} % shared"
    if math.isnan(gap.half):
        return f"too little to measure: {shared}"
    return f"half within {1e3 * gap.half:.1f} mm, 90 % within {1e3 * gap.most:.1f} mm, {shared}: {gap.verdict}"


def histogram_panel(axis: Any, title: str, values: NDArray[np.floating], unit: str, *, whole: bool = False) -> None:
    """Draw how often numbers come; ``whole``: a bar for each whole number, where they are not too many."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    own = np.arange(low - 0.5, high + 1) if whole and high - low < 40 else 40
    counts, edges = np.histogram(finite, bins=own)
    axis.set_title(label_text(title), fontsize=9)
    axis.stairs(counts, edges, fill=True, color=PALETTE[0])
    axis.set_xlabel(label_text(unit), fontsize=7)
    _plain(axis)
    axis.xaxis.get_major_locator().set_params(integer=whole)
    axis.yaxis.get_major_locator().set_params(integer=True)


def boxes_panel(axis: Any, samples: Sequence[tuple[str, Sequence[tuple[float, float, float]]]]) -> None:
    """Draw length, width and height of the box of every object in some samples, and how many each has."""
    axis.set_title("edges of the boxes of objects in the samples that are shown [cm]", fontsize=9)
    across = [place + _beside(number, len(own)) for place, (_, own) in enumerate(samples) for number in range(len(own))]
    edges = 100 * np.array([box for _, own in samples for box in own], dtype=np.float64).reshape(-1, 3)
    axis.vlines(across, edges.min(1, initial=np.inf), edges.max(1, initial=0), color="#d9d9d4", linewidth=1, zorder=1)
    for column, name in enumerate(("length", "width", "height")):
        axis.plot(across, edges[:, column], "_", color=PALETTE[column], markersize=7, markeredgewidth=2, label=name)
    room = axis.get_position().width * axis.figure.get_size_inches()[0]
    every = -(-len(samples) // max(int(room / _NAME_WIDTH), 1))
    told = [
        f"{label_text(_short(sample_id, 14))}\n{len(own)} object{'s' * (len(own) != 1)}"
        for sample_id, own in samples[::every]
    ]
    axis.set_xticks(range(0, len(samples), every), told)
    axis.set_xlim(-0.6, len(samples) - 0.4)
    axis.set_ylim(0, max(1.1 * float(edges.max(initial=0)), 1.0))
    axis.legend(fontsize=6, frameon=False, ncols=3)
    _plain(axis)


def _beside(number: int, count: int) -> float:
    """Where one of several objects stands within the room of its sample."""
    return 0.7 * ((number + 0.5) / count - 0.5)


def _plain(axis: Any) -> None:
    axis.tick_params(labelsize=7)
    axis.spines[["top", "right"]].set_visible(False)


def _short(text: str, longest: int = 60) -> str:
    return text if len(text) <= longest else f"{text[: longest - 3]}..."
