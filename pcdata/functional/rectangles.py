"""The smallest rectangle around points of a plane."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.errors import ShapeError, TooFewPointsError
from pcdata.functional.selection import convex_hull


def smallest_rectangle(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # center (2,), direction (2,), size (2,)
    """Return the rectangle of least area around points (N, 2): its center, the direction of its longer side, its sides.

    One side lies on an edge of the convex hull; of equal areas the first such edge counts. All is float64; the
    direction has unit length and x >= 0. Points on a line, or one point, have a side of 0.

    Raises:
        ShapeError: the points are not (N, 2).
        TooFewPointsError: there are none.

    Source: Freeman and Shapira, Determining the minimum-area encasing rectangle, CACM 18(7), 1975.
    """
    if points.ndim != 2 or points.shape[1] != 2:
        raise ShapeError(f"smallest_rectangle: points must be (N, 2), got {tuple(points.shape)}")
    if not len(points):
        raise TooFewPointsError("smallest_rectangle: there are no points")
    wide = points.detach().double()
    corners = wide[convex_hull(wide)]
    edges = corners.roll(-1, 0) - corners
    length = edges.norm(dim=1, keepdim=True)
    along = torch.where(length > 0, edges / length, wide.new_tensor([1.0, 0.0]))
    aside = torch.stack([-along[:, 1], along[:, 0]], 1)
    places = torch.stack([corners @ along.T, corners @ aside.T])  # (2, corners, edges)
    low, high = places.amin(1), places.amax(1)
    best = int((high - low).prod(0).argmin())
    axes = torch.stack([along[best], aside[best]])
    size, middle = (high - low)[:, best], ((high + low) / 2)[:, best]
    center = middle @ axes
    longer = int(size.argmax())
    direction = axes[longer]
    if float(direction[0]) < 0 or (float(direction[0]) == 0 and float(direction[1]) < 0):
        direction = -direction
    return center, direction, torch.stack([size[longer], size[1 - longer]])
