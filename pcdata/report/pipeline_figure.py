"""One picture of what a pipeline did: the capture, the cloud after its steps, and how many points each left."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pcdata import extras
from pcdata.files.opening import replacing
from pcdata.report.labels import label_text
from pcdata.structures import METRE, DepthFrame, PointCloud

_PALETTE = (
    *("#4269d0", "#efb118", "#ff725c", "#6cc5b0", "#3ca951"),
    *("#ff8ab7", "#a463f2", "#97bbf5", "#9c6b4e", "#9498a0"),
)
_COLUMNS = 4
_MAX_DRAWN = 60_000  # more points than a panel has pixels only cost time


def save_pipeline_figure(
    path: str | Path, capture: DepthFrame | PointCloud, stages: Sequence[tuple[str, PointCloud]], *, title: str = ""
) -> None:
    """Draw a capture and the clouds that came of it into one PNG; needs no display.

    Args:
        path: the PNG file.
        capture: of depth images the first view is drawn; a capture that is a cloud is drawn as one.
        stages: (caption, cloud) in order; drawn in the camera's colors, by object once clustered, by normal at last.
        title: printed above all.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    extras.require("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # no pyplot: no global state, no display
    from matplotlib.figure import Figure

    rows = -(-(3 + len(stages)) // _COLUMNS)
    figure = Figure(figsize=(4.2 * _COLUMNS, 3.6 * rows), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(label_text(title), fontsize=15, fontweight="bold")
    axes = iter(figure.subplots(rows, _COLUMNS, squeeze=False).flatten())
    if isinstance(capture, PointCloud):
        _draw_cloud(next(axes), "capture", capture)
        _draw_distances(next(axes), capture)
    else:
        _draw_colors(next(axes), capture)
        _draw_depth(figure, next(axes), capture)
    for caption, cloud in stages:
        _draw_cloud(next(axes), caption, cloud)
    _draw_counts(next(axes), stages)
    for axis in axes:
        axis.set_axis_off()
    with replacing("save_pipeline_figure", path) as temporary:
        figure.savefig(temporary, format="png")


def _draw_colors(axis: Any, capture: DepthFrame) -> None:
    axis.set_title(f"color, view 1 of {capture.num_views}")
    axis.set_axis_off()
    if capture.colors is not None:
        axis.imshow(capture.colors[0].cpu().numpy())


def _draw_depth(figure: Any, axis: Any, capture: DepthFrame) -> None:
    depth = capture.depth[0].cpu().numpy()
    valid = depth > 0
    axis.set_title(f"depth, {100 * valid.mean():.0f} % valid (holes white)")
    axis.set_axis_off()
    image = axis.imshow(np.where(valid, depth, np.nan), cmap="viridis")
    figure.colorbar(image, ax=axis, label="metres", shrink=0.8)


def _draw_distances(axis: Any, capture: PointCloud) -> None:
    seen_from = capture.viewpoint_per_point()
    away = capture.points if seen_from is None else capture.points - seen_from
    axis.set_title("points by distance from the " + ("origin" if seen_from is None else "sensor"))
    axis.hist(away.norm(dim=1).cpu().numpy(), bins=60, color=_PALETTE[0])
    axis.set_xlabel("metres" if capture.unit == METRE else label_text(capture.unit))


def _draw_counts(axis: Any, stages: Sequence[tuple[str, PointCloud]]) -> None:
    names = [label_text(caption) for caption, _ in stages]
    counts = [cloud.num_points for _, cloud in stages]
    axis.set_title("points left after each step")
    axis.barh(range(len(counts)), counts, color=_PALETTE[0], log=any(counts))  # by position: captions may repeat
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.set_xlim(left=0.8, right=max(counts, default=1) * 8 + 1)
    for position, count in enumerate(counts):
        axis.text(count * 1.15, position, f"{count:,}", va="center", fontsize=8)
    axis.tick_params(labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)


def _draw_cloud(axis: Any, caption: str, cloud: PointCloud) -> None:
    """Draw an oblique orthographic view, far points first."""
    axis.set_title(f"{label_text(caption)}: {cloud.num_points:,} points", fontsize=10)
    axis.set_axis_off()
    stride = max(1, cloud.num_points // _MAX_DRAWN)
    points = cloud.points[::stride].cpu().double()
    across, up, toward = (points @ _view_axes(cloud.frame_id).T).unbind(1)
    order = toward.argsort()
    colors = _point_colors(cloud)[::stride][order.numpy()]
    size = float(np.clip(4000 / max(cloud.num_points, 1), 0.4, 6.0))
    axis.scatter(across[order], up[order], c=colors, s=size, linewidths=0, rasterized=True)
    axis.set_aspect("equal")


def _view_axes(frame_id: str) -> torch.Tensor:
    """Return rows right, up, toward the viewer: obliquely from above for z-up frames, from the lens for cameras."""
    if frame_id.startswith("camera"):
        return torch.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]], dtype=torch.float64, device="cpu")
    turn, tilt = np.deg2rad(35.0), np.deg2rad(40.0)
    right = [np.cos(turn), np.sin(turn), 0.0]
    toward = [np.sin(turn) * np.cos(tilt), -np.cos(turn) * np.cos(tilt), np.sin(tilt)]
    up = np.cross(toward, right)
    return torch.tensor(np.array([right, up, toward]), dtype=torch.float64, device="cpu")


def _point_colors(cloud: PointCloud) -> np.ndarray:
    """Color by normal where there are normals, by object once they were clustered, else by the camera's colors."""
    from matplotlib.colors import to_rgb

    if cloud.normals is not None:
        return (cloud.normals.cpu().numpy() + 1) / 2
    clustered = any(step["step"] == "ClusterObjects" for step in cloud.history[0])
    if clustered and cloud.labels is not None:
        palette = np.array([to_rgb(color) for color in _PALETTE])
        labels = cloud.labels.cpu().numpy()
        return np.where(labels[:, None] < 0, 0.8, palette[labels % len(palette)])
    if cloud.colors is not None:
        return cloud.colors.cpu().numpy()
    return np.full((cloud.num_points, 3), 0.3)
