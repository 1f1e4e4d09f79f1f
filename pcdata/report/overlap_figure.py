"""One picture of whether the cameras of a rig agree: their points over each other, and the gaps between them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from pcdata import extras
from pcdata.files.opening import replacing
from pcdata.functional.depth.deproject import deproject_depth
from pcdata.functional.rows import cloud_of_rows, transform_points
from pcdata.report.labels import label_text
from pcdata.structures import DepthFrame, PointCloud
from pcdata.validation.overlap_result import OverlapResult
from pcdata.verdicts import Verdict

_PALETTE = ("#4269d0", "#ff725c", "#3ca951", "#efb118", "#a463f2", "#6cc5b0", "#9c6b4e", "#ff8ab7")
_VERDICT_COLORS = {
    Verdict.PASS: "#3ca951",
    Verdict.UNKNOWN: "#9498a0",
    Verdict.WARN: "#efb118",
    Verdict.FAIL: "#d62728",
}
_MAX_DRAWN = 30_000  # points per view: more only cost time
_REACH = 0.6  # metres around the middle of the overlap: about one workspace
_SLICE = 0.01  # metres, thickness of the cut that shows double surfaces


def save_overlap_figure(
    path: str | Path, capture: DepthFrame | PointCloud, result: OverlapResult, *, title: str = ""
) -> None:
    """Draw the views over each other, from above, from the side and as a thin cut, with the residuals, into one PNG.

    Args:
        path: the PNG file.
        capture: what :func:`verify_overlap` judged.
        result: what it found.
        title: printed above all.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    extras.require("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # no pyplot: no global state, no display
    from matplotlib.figure import Figure

    points, view = _points_of(capture)
    center = (
        torch.tensor([camera.center for camera in result.cameras], dtype=torch.float64, device="cpu").median(0).values
    )
    near = ((points - center).abs() < _REACH).all(1)
    points, view = points[near], view[near]

    figure = Figure(figsize=(12, 8), dpi=80, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(
        f"{label_text(title) + ': ' if title else ''}overlap {result.verdict}", fontsize=14, fontweight="bold"
    )
    (above, side), (cut, gaps) = figure.subplots(2, 2)
    names = [label_text(camera.name) for camera in result.cameras]
    _draw(above, points, view, (0, 1), "from above", names)
    _draw(side, points, view, (0, 2), "from the side", names)
    thin = ((points[:, 1] - center[1]).abs() < _SLICE / 2) & ((points[:, 0] - center[0]).abs() < _REACH / 3)
    _draw(cut, points[thin], view[thin], (0, 2), f"cut of {1e3 * _SLICE:.0f} mm through the middle", names)
    _draw_gaps(gaps, result)
    with replacing("save_overlap_figure", path) as temporary:
        figure.savefig(temporary, format="png")


def _points_of(capture: DepthFrame | PointCloud) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (N, 3) float64 points in the common frame and the view (N,) of each, thinned evenly."""
    if isinstance(capture, PointCloud):
        points, ptr = capture.points, capture.ptr
    else:
        assert capture.world_from_camera is not None  # verify_overlap required it
        camera = capture.camera.to(capture.device)
        points, ptr, _ = deproject_depth(capture.depth, camera.intrinsics, distortion=camera.distortion)
        points = transform_points(points, ptr, capture.world_from_camera)
    view = cloud_of_rows(ptr)
    stride = max(1, len(points) // (_MAX_DRAWN * (len(ptr) - 1)))
    return points[::stride].cpu().double(), view[::stride].cpu()


def _draw(axis: Any, points: torch.Tensor, view: torch.Tensor, plane: tuple[int, int], what: str, names: Any) -> None:
    axis.set_title(what)
    # Interleaved, so that no camera covers the others.
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0), device="cpu").numpy()
    colors = np.array(_PALETTE)[view.numpy()[order] % len(_PALETTE)]
    size = float(np.clip(20_000 / max(len(points), 1), 0.3, 4.0))
    axis.scatter(points[order, plane[0]], points[order, plane[1]], c=colors, s=size, linewidths=0, rasterized=True)
    axis.set_aspect("equal")
    axis.set_xlabel(f"{'xyz'[plane[0]]} (m)")
    axis.set_ylabel(f"{'xyz'[plane[1]]} (m)")
    for position, name in enumerate(names):
        axis.scatter([], [], c=_PALETTE[position % len(_PALETTE)], s=20, label=name)
    axis.legend(loc="upper right", fontsize=7)


def _draw_gaps(axis: Any, result: OverlapResult) -> None:
    axis.set_title("gap between the surfaces of each pair")
    edges = np.linspace(-15, 15, 61)
    for pair in result.pairs:
        if pair.num_samples:
            share = np.array(pair.histogram) / pair.num_samples
            line = "-" if pair.verdict is Verdict.PASS else "--"
            label = label_text(f"{pair.first} - {pair.second}: {1e3 * pair.median:.1f} mm")
            axis.stairs(share, edges, label=label, linestyle=line)
    axis.axvspan(-1e3 * result.limits.residual[0], 1e3 * result.limits.residual[0], color="#3ca951", alpha=0.12)
    axis.set_xlabel("mm, positive: the first lies in front")
    axis.set_yticks([])
    axis.legend(loc="upper right", fontsize=7)
    for row, camera in enumerate(result.cameras):
        moved = f"{1e3 * camera.shift:.1f} mm, {camera.rotation_degrees:.2f} degrees"
        axis.text(
            0.01,
            0.97 - 0.06 * row,
            f"{label_text(camera.name)}: {moved}, {camera.verdict}",
            transform=axis.transAxes,
            va="top",
            fontsize=8,
            color=_VERDICT_COLORS[camera.verdict],
        )
