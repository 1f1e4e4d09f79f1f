"""Points at the rim of a surface."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count, checked_length, checked_positive
from pcdata.errors import ConfigError
from pcdata.functional.neighbor_rows import nearest_rows
from pcdata.geometry.shape_fit import across, dot, length

_ROWS = 1 << 21  # neighbors whose angles are alive at once


def checked_gap(where: str, name: str, arguments: Mapping[str, Any]) -> float:
    """Require an angle of less than a turn."""
    value = checked_positive(where, name, arguments)
    if value >= 2 * math.pi:
        raise ConfigError(f"{where}: {name} must be less than a full turn, in radians, got {value}")
    return value


@op(
    points="N 3",
    normals="N 3",
    ptr="ptr N B",
    radius=checked_length,
    max_neighbors=checked_count,
    min_gap=checked_gap,
    steps=(nearest_rows,),
    gradient=False,
)
def boundary_mask(
    points: Tensor,  # (N, 3) float32
    normals: Tensor,  # (N, 3) float32, of any length and either sign
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    radius: float | None = None,
    max_neighbors: int = 30,
    min_gap: float = math.pi / 2,
    backend: str = "auto",
) -> Tensor:  # (N,) bool, True = at the rim
    """Mark the points at the rim of their surface: seen along the normal, a wide sector around them has no neighbor.

    The neighbors (the nearest ``max_neighbors``, d < radius) are projected onto the plane of the normal, and the
    directions to them sorted by angle in float64; a point is at the rim where two of them in turn are more than
    ``min_gap`` apart. Points at the same place, or in front and behind, have no direction. Fewer than three neighbors,
    the point itself among them, or a normal of length 0 tell nothing, and no rim.

    Args:
        points: the clouds, in any unit of length.
        normals: of the surface at every point.
        ptr: row pointers.
        radius: in the unit of the points; None = the nearest, however far.
        max_neighbors: nearest points used at most, the point itself included.
        min_gap: radians.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
        ConfigError: a parameter out of range.

    Source: PCL, BoundaryEstimation; Rusu, Semantic 3D object maps, 2009.
    """
    assert ptr is not None  # @op fills it
    index, _ = nearest_rows(points, ptr, max_neighbors, radius=radius, backend=backend)
    rim = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    wide, directions = points.double(), normals.double()
    for rows in torch.arange(len(points), dtype=torch.int64, device=points.device).split(
        max(1, _ROWS // max_neighbors)
    ):
        near, size = index[rows], length(directions[rows])
        found = near < len(points)
        normal = directions[rows] / torch.where(size > 0, size, 1.0)[:, None]
        first, second = across(torch.where((size > 0)[:, None], normal, normal.new_tensor([0.0, 0.0, 1.0])))
        offset = wide[near.clamp(max=len(points) - 1)] - wide[rows][:, None]
        x, y = dot(offset, first[:, None]), dot(offset, second[:, None])
        told = found & ((x != 0) | (y != 0))
        angle = torch.where(told, torch.atan2(y, x), torch.inf).sort(1).values
        number = told.sum(1)
        last = angle.gather(1, (number - 1).clamp(min=0)[:, None])[:, 0]
        between = torch.where(angle[:, 1:] < torch.inf, angle[:, 1:] - angle[:, :-1], 0.0)
        widest = torch.cat([between, (2 * math.pi - last + angle[:, 0])[:, None]], 1).amax(1)
        rim[rows] = (found.sum(1) >= 3) & (size > 0) & (number > 0) & (widest > min_gap)
    return rim
