"""One call for people who plot: clouds, captures and the steps of a chain as panels of a matplotlib figure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import torch

from pcdata import extras
from pcdata.errors import DTypeError, PcdataError
from pcdata.report.figures.panels import (
    cloud_panel,
    confidence_panel,
    depth_panel,
    funnel_panel,
    rims_panel,
    trend_panel,
)
from pcdata.report.html.gathering import told_trends
from pcdata.report.html.scene import MOST_POINTS, raw_cloud, stage_of
from pcdata.report.labels import label_text
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms import Transform
from pcdata.validation.grading import Grading
from pcdata.validation.view_names import view_names

_MOST_VIEWS = 8
_WIDTH, _HEIGHT = 4.6, 3.8  # inches of a panel
_DPI = 110
Panel = Callable[[Any], None]  # draws into axes
Step = tuple["str | Transform", "DepthFrame | PointCloud"]


def figure(
    shown: DepthFrame | PointCloud | Grading | Iterable[Step],
    *,
    color: str | Sequence[str] | None = None,
    lines: bool = True,
    grasps: torch.Tensor | None = None,
    title: str = "",
    columns: int = 3,
    point_size: float | None = None,
    max_points: int = MOST_POINTS,
) -> Any:
    """Return a matplotlib ``Figure`` of a cloud, a capture, the steps of a chain, or the trends of a grading.

    It is drawn by Agg without a display, and pyplot knows nothing of it: ``figure.savefig("a.png")`` keeps it, a
    notebook shows it as the last value of a cell.

    Args:
        shown: a cloud (one panel for each color); a capture (depth, rims over color and confidence of each view, and
            its cloud); pairs of a caption or step and what it left, such as ``chain.step_through(frame)`` (a panel for
            each cloud, and the points after each); or a :class:`~pcdata.validation.grading.Grading` (its trends).
        color: what points are colored by: ``"colors"``, ``"labels"``, ``"normals"``, ``"camera"``, any other field,
            ``"height"`` or ``"distance"``; several = a panel each. None = the first that the cloud has.
        lines: draw axes, boxes of objects, planes, cameras, the workspace and grasps.
        grasps: (G, 4, 4) poses in the frame of the last cloud, x between the fingers and z toward the object.
        title: printed above all.
        columns: panels side by side at most.
        point_size: width of a point in the cloud's unit; None = what closes its surfaces.
        max_points: drawn of each cloud; of more every k-th is.

    Raises:
        MissingExtraError: matplotlib is not installed.
        DTypeError: something else is shown.
        ConfigError: a cloud has nothing of the name ``color``, or the grading measured nothing.
    """
    extras.require("matplotlib")
    colors = [color] if color is None or isinstance(color, str) else [*color]
    draw = partial(cloud_panel, lines=lines, point_size=point_size)
    panels: list[Panel] = []
    if isinstance(shown, Grading):
        panels = [partial(trend_panel, trend=trend, name=name) for name, trend in told_trends(shown)]
    elif isinstance(shown, DepthFrame):
        panels = frame_panels(shown)
        stage = stage_of("capture", raw_cloud(shown), grasps=grasps, most_points=max_points)
        panels += [partial(draw, stage=stage, color=one) for one in colors]
    elif isinstance(shown, PointCloud):
        stage = stage_of("cloud", shown, grasps=grasps, most_points=max_points)
        panels = [partial(draw, stage=stage, color=one) for one in colors]
    else:
        panels = _step_panels(shown, colors, draw, grasps, max_points)
    if not panels:
        raise PcdataError("figure: nothing to draw")
    return figure_of(panels, title=title, columns=columns)


def frame_panels(frame: DepthFrame) -> list[Panel]:
    """Return the panels of a capture's images: depth, and its rims over color and confidence where there are any."""
    names = view_names(frame.provenance, frame.num_views)
    panels: list[Panel] = []
    for view in range(min(frame.num_views, _MOST_VIEWS)):
        kinds: list[Any] = [depth_panel]
        kinds += [rims_panel] * (frame.colors is not None) + [confidence_panel] * (frame.confidence is not None)
        panels += [partial(kind, frame=frame, view=view, name=names[view]) for kind in kinds]
    return panels


def _step_panels(
    steps: Iterable[Step], colors: Sequence[str | None], draw: Any, grasps: torch.Tensor | None, max_points: int
) -> list[Panel]:
    panels: list[Panel] = []
    funnel: list[tuple[str, float]] = []
    pairs = [*steps] if isinstance(steps, Iterable) else [steps]  # what is none is refused as a pair
    for place, pair in enumerate(pairs):
        name, data = _checked(pair)
        if isinstance(data, DepthFrame):
            panels += frame_panels(data)
            continue
        step = pair[0] if isinstance(pair[0], Transform) else None
        own = grasps if place == len(pairs) - 1 else None
        stage = stage_of(name, data, step=step, grasps=own, most_points=max_points)
        panels += [partial(draw, stage=stage, color=one) for one in colors]
        funnel.append((name, data.num_points))
    return [*panels, partial(funnel_panel, funnel=funnel)] if len(funnel) > 1 else panels


def _checked(pair: Any) -> tuple[str, DepthFrame | PointCloud]:
    if not isinstance(pair, tuple) or len(pair) != 2 or not isinstance(pair[1], (DepthFrame, PointCloud)):
        raise DTypeError(
            "figure: takes a PointCloud, a DepthFrame, a Grading, or pairs of a caption and one of the first two, "
            f"not {type(pair).__name__}"
        )
    caption, data = pair
    return (type(caption).__name__ if isinstance(caption, Transform) else str(caption)), data


def figure_of(
    panels: Sequence[Panel], *, title: str = "", columns: int = 3, width: float = _WIDTH, height: float = _HEIGHT
) -> Any:
    """Return a figure of panels of ``width`` by ``height`` inches, row by row."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = max(1, min(columns, len(panels)))
    rows = -(-len(panels) // columns)
    drawn = Figure(figsize=(width * columns, height * rows + 0.4 * bool(title)), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(drawn)
    if title:
        drawn.suptitle(label_text(title), fontsize=13, fontweight="bold")
    axes = iter(drawn.subplots(rows, columns, squeeze=False).flatten())
    for panel in panels:
        panel(next(axes))
    for axis in axes:
        axis.set_axis_off()
    return drawn
