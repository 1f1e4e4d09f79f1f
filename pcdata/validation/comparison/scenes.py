"""What stands in a scene: the table, and how many things of which size on it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.errors import PcdataError
from pcdata.functional.clusters import dbscan
from pcdata.functional.plane_segments import supporting_plane
from pcdata.functional.selection import over_hull, plane_axes
from pcdata.functional.voxels import voxel_downsample
from pcdata.validation.comparison.distances import octave

_MOST_POINTS = 20_000  # that tell the plane
# Metres, at up to 1.4 m: beyond, all grow with the distance.
_OFF_PLANE = 0.01
_VOXEL = 0.005
_LOWEST, _HIGHEST = 0.012, 0.5  # above the table: what belongs to a thing on it
_LEAST_TOP = 0.02  # of a thing
_LEAST_VOXELS = 40  # of a thing: 10 square centimetres
_FEWEST = 200  # points of a scene


class Table(NamedTuple):
    """The plane that things stand on: unit normal toward the viewpoint, offset; and the middle of its points."""

    plane: Tensor  # (4,) float64
    center: Tensor  # (3,) float64


def measure_scene(
    points: Tensor,  # (N, 3) float32 metres
    *,
    likely_up: tuple[float, float, float],
    viewpoint: Tensor | None,  # (3,), where the sensor stood; None = above
    distance: float,  # metres from the sensor, about
) -> tuple[Table | None, dict[str, float]]:
    """Find the table and what stands on it: ``objects``, and the medians of ``object_height`` and ``object_size``."""
    if len(points) < _FEWEST:
        return None, {}
    grown = octave(distance)
    some = points[:: max(1, len(points) // _MOST_POINTS)].contiguous()
    above = torch.tensor(likely_up, dtype=torch.float64, device="cpu") * 1e3
    try:
        planes, near = supporting_plane(
            some,
            distance=_OFF_PLANE * grown,
            likely_up=likely_up,
            viewpoint=(above if viewpoint is None else viewpoint.double())[None],
        )
    except PcdataError:  # no plane holds enough of it
        return None, {}
    plane = planes[0]
    table = Table(plane, some[near].double().mean(0))
    return table, _things(points, some[near], plane, grown)


def _things(points: Tensor, base: Tensor, plane: Tensor, grown: float) -> dict[str, float]:
    voxel = _VOXEL * grown
    height = points.double() @ plane[:3] + plane[3]
    high = (height > _LOWEST * grown) & (height < _HIGHEST * grown)
    own = points[high]
    if len(own):
        own = own[over_hull(own, base, plane, 0.0)]
    if not len(own):
        return {"objects": 0.0}
    means, _, _ = voxel_downsample(own, voxel_size=voxel)
    part = dbscan(means, eps=3 * voxel, min_points=4)
    flat = means.double() @ plane_axes(plane)
    height = means.double() @ plane[:3] + plane[3]
    tops, sizes = [], []
    for number in range(int(part.max()) + 1):
        rows = part == number
        if int(rows.sum()) < _LEAST_VOXELS:
            continue
        top = float(torch.quantile(height[rows], 0.98))
        if top < _LEAST_TOP * grown:
            continue
        tops.append(top)
        # Of a line of length L the standard deviation is L / sqrt(12); strays hardly change it.
        sizes.append(float(12 * flat[rows].var(0).sum()) ** 0.5)
    if not tops:
        return {"objects": 0.0}
    middle = (float(torch.tensor(one, dtype=torch.float64, device="cpu").median()) for one in (tops, sizes))
    return {"objects": float(len(tops)), **dict(zip(("object_height", "object_size"), middle))}
