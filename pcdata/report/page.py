"""A page in Python's hands: shown in a notebook, or kept as a file."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from pcdata.errors import DTypeError
from pcdata.files.opening import replacing
from pcdata.report.html.page import page_of
from pcdata.report.html.scene import MOST_POINTS, SampleScene, raw_cloud, stage_of
from pcdata.structures import DepthFrame, PointCloud

_HEIGHT = 760  # pixels of a notebook's cell


@dataclass(frozen=True, repr=False)
class Page:
    """A self-contained page with an interactive view.

    A notebook shows it by itself; elsewhere :meth:`save` it and open the file in a browser.

    Args:
        html: the whole page.
    """

    html: str

    def save(self, path: str | Path) -> Path:
        """Write the page to a file, replacing it; return where it is."""
        with replacing("Page.save", path) as temporary:
            Path(temporary).write_text(self.html, encoding="utf-8")
        return Path(path)

    def _repr_html_(self) -> str:
        # A frame of its own: neither its style nor its script meets those of the notebook.
        source = html.escape(self.html, quote=True)
        style = f"width:100%;height:{_HEIGHT}px;border:0"
        return f'<iframe srcdoc="{source}" sandbox="allow-scripts" style="{style}"></iframe>'

    def __repr__(self) -> str:
        return f"Page({len(self.html.encode()) / 1e6:.1f} MB; a notebook shows it, save('view.html') keeps it)"


def page_of_views(
    views: Sequence[tuple[str, DepthFrame | PointCloud]],
    title: str,
    *,
    max_points: int = MOST_POINTS,
    grasps: torch.Tensor | None = None,
) -> Page:
    """Return a page with one view that steps through captures and clouds.

    Args:
        views: (caption, capture or cloud) in order; of depth images the points that they show.
        title: of the page.
        max_points: drawn of each; of more every k-th is.
        grasps: (G, 4, 4) poses in the frame of the last cloud, x between the fingers and z toward the object.

    Raises:
        DTypeError: it is something else.
        TooFewPointsError: depth images without a reading.
    """
    stages = []
    for place, (caption, data) in enumerate(views):
        if not isinstance(data, (DepthFrame, PointCloud)):
            raise DTypeError(f"show: takes a DepthFrame or a PointCloud, not {type(data).__name__}")
        cloud = data if isinstance(data, PointCloud) else raw_cloud(data)
        own = grasps if place == len(views) - 1 else None
        stages.append(stage_of(caption, cloud, grasps=own, most_points=max_points))
    return Page(page_of(title, [], [SampleScene(title, tuple(stages))], viewer_after=0))
