"""What the points of a cloud show without their depth image: where they end, how dense and how noisy they are."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from pcdata.validation.comparison.depth_images import by_class
from pcdata.validation.comparison.distances import octave

_Numbers = dict[str, float]

_PATCHES, _POINTS = 160, 40_000  # looked at, of a cloud
_RADIUS = 0.025  # metres of a patch at 1 m
_LEAST_POINTS, _LEAST_PATCHES = 12, 8
_ROUND = 0.1  # second over first axis of a patch that is no edge
_FLATTEST = 0.25  # quantile of the patches, as of the tiles of images


def measure_points(points: Tensor, viewpoint: Tensor | None) -> _Numbers:
    """Return the numbers of points (N, 3) in metres; ``viewpoint`` (3,), where the sensor stood, if one did."""
    found: _Numbers = {"points": float(len(points))}
    if len(points) < _LEAST_POINTS:
        return found
    some = points[:: max(1, len(points) // _POINTS)].double()
    low, high = (torch.quantile(some, q, dim=0).tolist() for q in (0.01, 0.99))
    least, most = points.amin(0).tolist(), points.amax(0).tolist()
    for axis, name in enumerate("xyz"):
        found |= {f"lower_{name}": low[axis], f"upper_{name}": high[axis]}
        found |= {f"min_{name}": least[axis], f"max_{name}": most[axis]}
    away = (some - (some.mean(0) if viewpoint is None else viewpoint.double())).norm(dim=1)
    if viewpoint is not None:
        found |= dict(zip(("near", "median", "far"), np.quantile(away.numpy(), [0.02, 0.5, 0.98]).tolist()))
    return {**found, **_patches(some, away, len(points) / len(some))}


def _patches(points: Tensor, away: Tensor, points_each: float) -> _Numbers:
    """Return ``density@class`` in points per square metre of surface and ``noise@class`` in metres."""
    seeds = torch.arange(0, len(points), max(1, len(points) // _PATCHES), dtype=torch.int64, device="cpu")
    radius = _RADIUS * octave(float(away.median()))
    center = points - points.mean(0)
    near = (torch.cdist(center[seeds], center) < radius).double()
    count = near.sum(1)
    mean = (near @ center) / count[:, None]
    squares = (near @ (center[:, :, None] * center[:, None]).reshape(-1, 9)).reshape(-1, 3, 3) / count[:, None, None]
    if not bool(torch.isfinite(squares).all()):  # coordinates near the end of what a float holds
        return {}
    spread = torch.linalg.eigvalsh(squares - mean[:, :, None] * mean[:, None]).clamp(min=0)
    flat = (count >= _LEAST_POINTS) & (spread[:, 1] > _ROUND * spread[:, 2])
    if not bool(flat.any()):
        return {}
    sigma = (spread[:, 0] * count / (count - 3).clamp(min=1)).sqrt()[flat].numpy()
    density = (count * points_each / (math.pi * radius**2))[flat].numpy()
    distance = away[seeds][flat].numpy()
    return {
        **by_class("density", distance, density, _LEAST_PATCHES, 0.5),
        **by_class("noise", distance, sigma, _LEAST_PATCHES, _FLATTEST),
    }
