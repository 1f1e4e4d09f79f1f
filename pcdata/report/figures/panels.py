"""Panels of figures: each draws one thing into the axes that it is given."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image

from pcdata.report.figures.cloud_picture import cloud_picture
from pcdata.report.html.charts import VERDICT_COLORS
from pcdata.report.html.pictures import NO_READING, rims
from pcdata.report.html.scene import Stage
from pcdata.report.labels import label_text
from pcdata.structures import METRE, DepthFrame
from pcdata.validation.grading import Trend

_MOST_NAMED = 8  # categories in a legend


def cloud_panel(
    axis: Any,
    stage: Stage,
    *,
    color: str | None = None,
    lines: bool = True,
    point_size: float | None = None,
    size: tuple[int, int] = (480, 600),
) -> None:
    """Draw a cloud in space with the lines around it, and say how many points, and in which frame."""
    from matplotlib.collections import LineCollection

    picture = cloud_picture(stage, color=color, size=size, point_size=point_size)
    said = stage.cloud.said
    unit = "m" if said["unit"] == METRE else said["unit"]
    told = label_text(f"{said['total']:,} points in '{_short(said['frame'], 24)}' [{unit}]")
    axis.set_title(f"{label_text(_short(stage.caption))}\n{told}", fontsize=9)
    axis.imshow(picture.image)
    axis.set_xlim(-0.5, size[1] - 0.5)
    axis.set_ylim(size[0] - 0.5, -0.5)
    _frame(axis)
    if not said["count"]:
        axis.text(0.5, 0.5, "no points", transform=axis.transAxes, ha="center", va="center")
    for name, drawn, ends, hidden in picture.lines if lines else ():
        for some, alpha in ((ends[~hidden], 1.0), (ends[hidden], 0.2)):
            if len(some):
                width = 1.6 if name.endswith("axis") else 1.0
                axis.add_collection(LineCollection([*some], colors=drawn, linewidths=width, alpha=alpha))
    if picture.coloring.span is not None and said["count"]:
        _color_bar(axis, picture.coloring.span)
    entries = picture.coloring.entries
    for name, drawn in entries[:_MOST_NAMED]:
        axis.plot([], [], "s", color=drawn, markersize=5, label=label_text(name))
    if entries:
        more = f"and {len(entries) - _MOST_NAMED} more" if len(entries) > _MOST_NAMED else None
        axis.legend(loc="lower left", fontsize=6, ncols=2, frameon=False, title=more, title_fontsize=6)


def depth_panel(axis: Any, frame: DepthFrame, view: int, name: str) -> None:
    """Draw depth in metres, pixels without a reading in magenta."""
    depth = frame.depth[view].cpu().numpy()
    valid = depth > 0
    axis.set_title(label_text(f"{_short(name)}: depth, {valid.mean():.1%} read (magenta: none)"), fontsize=9)
    low, high = np.quantile(depth[valid], [0.01, 0.99]).tolist() if valid.any() else (0.0, 1.0)
    image = axis.imshow(np.ma.masked_where(~valid, depth), cmap=_ramp(), vmin=low, vmax=high if high > low else low + 1)
    _bar_below(axis, image, "metres")
    _frame(axis)


def rims_panel(axis: Any, frame: DepthFrame, view: int, name: str) -> None:
    """Draw the color image with the rims of depth in red."""
    assert frame.colors is not None
    image = frame.colors[view].cpu().numpy().copy()
    image[rims(frame.depth[view].cpu().numpy())] = (255, 40, 40)
    axis.set_title(label_text(f"{_short(name)}: rims of depth (red) over color"), fontsize=9)
    axis.imshow(image)
    _frame(axis)


def confidence_panel(axis: Any, frame: DepthFrame, view: int, name: str) -> None:
    """Draw how sure the sensor was of each pixel."""
    assert frame.confidence is not None
    axis.set_title(label_text(f"{_short(name)}: confidence"), fontsize=9)
    image = axis.imshow(frame.confidence[view].cpu().numpy(), cmap="viridis")
    _bar_below(axis, image, "")
    _frame(axis)


def picture_panel(axis: Any, caption: str, png: bytes) -> None:
    """Draw a picture that is there already."""
    axis.set_title(label_text(_short(caption, 90)), fontsize=8, wrap=True)
    axis.imshow(np.asarray(Image.open(io.BytesIO(png)).convert("RGB")), interpolation="nearest")
    _frame(axis)


def funnel_panel(axis: Any, funnel: Sequence[tuple[str, float]]) -> None:
    """Draw the points after each step as bars, with the share of the step before."""
    counts = [count for _, count in funnel]
    axis.set_title("points after each step", fontsize=9)
    axis.barh(range(len(funnel)), counts, height=0.4, color="#4269d0")
    axis.set_xticks([])
    axis.set_yticks([])
    axis.set_ylim(len(funnel) - 0.5, -0.8)
    axis.set_xlim(0, 1.45 * (max(counts, default=0) or 1))
    for place, (name, _) in enumerate(funnel):
        axis.text(0, place - 0.27, label_text(f"{place + 1}. {_short(name, 40)}"), va="bottom", fontsize=7)
    for place, count in enumerate(counts):
        before = counts[place - 1] if place else 0
        kept = f" ({count / before:.0%})" if before else ""
        axis.text(count, place, f" {count:,.0f}{kept}", va="center", fontsize=8)
    axis.spines[["top", "right", "bottom"]].set_visible(False)


def trend_panel(axis: Any, trend: Trend, name: str) -> None:
    """Draw what a check measured over the samples, each in the color of its verdict, and its limit as a dashed line."""
    values, places = np.array(trend.values), np.array(trend.places)
    unit = f" [{trend.worst.unit}]" if trend.worst.unit else ""
    axis.set_title(label_text(f"{_short(name)}{unit}: {trend.verdict}"), fontsize=9)
    axis.scatter(places, values, s=9, c=[VERDICT_COLORS[severity] for severity in trend.verdicts], linewidths=0)
    if trend.worst.threshold is not None and np.isfinite(trend.worst.threshold):
        axis.axhline(trend.worst.threshold, linestyle="--", linewidth=0.8, color="#6b6b66")
    axis.xaxis.get_major_locator().set_params(integer=True)
    axis.tick_params(labelsize=7)
    axis.spines[["top", "right"]].set_visible(False)


def _color_bar(axis: Any, span: tuple[float, float]) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    low, high = span
    shades = ScalarMappable(Normalize(low, high if high > low else low + 1), cmap="viridis")
    beside = axis.inset_axes([0.94, 0.05, 0.02, 0.4])
    bar = axis.figure.colorbar(shades, cax=beside, ticklocation="left")
    bar.ax.tick_params(labelsize=7)
    bar.outline.set_linewidth(0.5)


def _bar_below(axis: Any, image: Any, label: str) -> None:
    bar = axis.figure.colorbar(image, ax=axis, location="bottom", aspect=40, pad=0.02, shrink=0.9)
    bar.set_label(label, fontsize=7)
    bar.ax.tick_params(labelsize=7)


def _ramp() -> Any:
    from matplotlib import colormaps

    return colormaps["viridis"].with_extremes(bad=tuple(value / 255 for value in NO_READING))


def _frame(axis: Any) -> None:
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set(linewidth=0.5, color="#d9d9d4")


def _short(text: str, longest: int = 60) -> str:
    return text if len(text) <= longest else f"{text[: longest - 3]}..."
