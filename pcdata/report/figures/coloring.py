"""What the points of a picture are colored by: the choices of the page's viewer, in NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import ConfigError, near_matches
from pcdata.report.html.pictures import viridis
from pcdata.report.html.unpacking import UnpackedCloud

# As web/src/colors.js has them.
PALETTE = (
    *("#4269d0", "#efb118", "#ff725c", "#6cc5b0", "#3ca951", "#ff8ab7"),
    *("#a463f2", "#97bbf5", "#9c6b4e", "#e15759", "#76b7b2", "#edc948"),
)
NONE = "#9498a0"  # of a category below zero, no label, and of what is no number
HEIGHT, DISTANCE = "height", "distance"


@dataclass(frozen=True)
class Coloring:
    """The color of every point, and what it means.

    Args:
        colors: (N, 3) 0 to 255.
        span: smallest and largest number of the ramp, None where colors are no ramp.
        entries: (name, color) of the categories that there are.
    """

    colors: NDArray[np.float64]
    span: tuple[float, float] | None = None
    entries: tuple[tuple[str, str], ...] = ()


def color_modes(cloud: UnpackedCloud) -> list[str]:
    """Return what a cloud can be colored by, the best first: its colors, categories, normals, numbers."""
    return [*(name for name, kind in cloud.kinds.items() if kind != "pixel"), HEIGHT, DISTANCE]


def coloring_of(cloud: UnpackedCloud, mode: str | None, up: NDArray[np.float64]) -> Coloring:
    """Color the points of a cloud.

    Args:
        cloud: of N points.
        mode: one of :func:`color_modes`; None = the first.
        up: (3,) the direction that height is measured along.

    Raises:
        ConfigError: the cloud has no such field.
    """
    modes = color_modes(cloud)
    mode = modes[0] if mode is None else mode
    if mode not in modes:
        raise ConfigError(
            f"color: {mode!r} is nothing that this cloud can be colored by; it has {', '.join(modes)}"
            f"{near_matches(mode, modes)}{'; EstimateNormals gives normals' if mode == 'normals' else ''}"
        )
    kind = cloud.kinds.get(mode)
    if kind in ("color", "normal"):
        return Coloring(cloud.fields[mode].astype(np.float64))
    if kind == "category":
        return _categories(cloud.fields[mode])
    if kind == "scalar":
        return _ramp(cloud.fields[mode])
    return _ramp(cloud.points @ up if mode == HEIGHT else np.linalg.norm(cloud.points, axis=1))


def _categories(values: NDArray[np.int64]) -> Coloring:
    hues = np.array([_bytes(color) for color in PALETTE], dtype=np.float64)
    colors = np.where(values[:, None] < 0, np.array(_bytes(NONE), dtype=np.float64), hues[values % len(PALETTE)])
    entries = [(str(one), NONE if one < 0 else PALETTE[one % len(PALETTE)]) for one in np.unique(values).tolist()]
    return Coloring(colors, entries=tuple(entries))


def _ramp(values: NDArray[np.float64]) -> Coloring:
    # From the 1st to the 99th percentile: one stray point does not take all the colors.
    there = np.isfinite(values)
    low, high = np.quantile(values[there], [0.01, 0.99]).tolist() if there.any() else (0.0, 1.0)
    colors = viridis((values - low) / ((high - low) or 1.0)).astype(np.float64)
    colors[~there] = _bytes(NONE)
    return Coloring(colors, span=(low, high))


def _bytes(color: str) -> list[int]:
    return [int(color[place : place + 2], 16) for place in (1, 3, 5)]
