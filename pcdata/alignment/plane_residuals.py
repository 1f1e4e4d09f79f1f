"""How far one surface lies from another: point-to-plane residuals where two clouds overlap."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.contracts.numbers import require_length
from pcdata.contracts.tensors import check_tensors
from pcdata.functional.neighbors import knn
from pcdata.functional.rows import ptr_from_counts
from pcdata.geometry import rigid


@dataclass(frozen=True, eq=False)
class PlaneResiduals:
    """Signed distances of source points to the target's tangent planes, where the two overlap."""

    residual: Tensor  # (M,) in the points' unit: target normal . (source point - target point)
    source_index: Tensor  # (M,) int64 rows of the source, ascending
    target_index: Tensor  # (M,) int64 rows of the target


def point_to_plane_residuals(
    source: Tensor,  # (N, 3) float32
    target: Tensor,  # (M, 3) float32, in the same frame
    target_normals: Tensor,  # (M, 3) float32 unit
    *,
    max_distance: float,
    source_normals: Tensor | None = None,  # (N, 3) float32 unit; None = normals are not compared
    max_normal_angle: float = 0.6,  # radians between the normals of partners, their signs ignored
) -> PlaneResiduals:
    """Measure the overlap of two clouds: each source point against the plane at its nearest target point.

    Points without a target point within ``max_distance`` (d < max_distance) do not overlap. Ties go to the lowest row.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
        ConfigError: a distance or angle that is not positive.
    """
    where = "point_to_plane_residuals"
    values = {"source": source, "target": target, "target_normals": target_normals, "source_normals": source_normals}
    check_tensors(where, values, {"source": "N 3", "target": "M 3", "target_normals": "M 3", "source_normals": "N 3"})
    require_length(where, "max_distance", max_distance)
    require_length(where, "max_normal_angle", max_normal_angle)
    device = source.device
    index, distance = knn(
        target,
        ptr_from_counts(torch.tensor([len(target)], dtype=torch.int64, device=device)),
        k=1,
        queries=source,
        queries_ptr=ptr_from_counts(torch.tensor([len(source)], dtype=torch.int64, device=device)),
    )
    rows = (distance[:, 0] < max_distance).nonzero().squeeze(1)
    partner = index[rows, 0]
    if source_normals is not None:
        agree = rigid.angle_between(source_normals[rows], facing(target_normals[partner], source_normals[rows]))
        alike = agree < max_normal_angle
        rows, partner = rows[alike], partner[alike]
    offset = source[rows].double() - target[partner].double()
    residual = (offset * target_normals[partner].double()).sum(1)
    return PlaneResiduals(residual, rows, partner)


def facing(normals: Tensor, reference: Tensor) -> Tensor:
    """Turn normals (M, 3) to the side of the reference normals."""
    return torch.where((normals * reference).sum(-1, keepdim=True) < 0, -normals, normals)
