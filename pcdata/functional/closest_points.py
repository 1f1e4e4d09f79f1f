"""Motions between clouds whose partners are not known: the nearest points are taken for them, again and again."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count, checked_length, checked_positive
from pcdata.errors import PoseError
from pcdata.functional.neighbor_rows import nearest_rows
from pcdata.functional.paired_points import checked_flag, fit_paired_points
from pcdata.functional.rows import count_per_cloud, counts_from_ptr, transform_points


class ClosestPoints(NamedTuple):
    """Where the points of each cloud go."""

    matrix: Tensor  # (B, 4, 4) float64, target from point: scale times rotation, and translation
    scale: Tensor  # (B,) float64, 1 without scale
    rmse: Tensor  # (B,) float64, to the partners of the last round, in the points' unit
    overlap: Tensor  # (B,) float64, part of the points that had a partner
    converged: Tensor  # (B,) bool


@op(
    points="N 3",
    targets="M 3",
    ptr="ptr N B >= 3",
    targets_ptr="ptr M B >= 1",
    initial="B 4 4 : float64",
    max_distance=checked_length,
    with_scale=checked_flag,
    max_rounds=checked_count,
    tolerance=checked_positive,
    steps=(nearest_rows,),
    gradient=False,
)
def iterate_closest_points(
    points: Tensor,  # (N, 3) float32
    targets: Tensor,  # (M, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    targets_ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    initial: Tensor | None = None,  # (B, 4, 4) float64 target from point; None = the identity
    max_distance: float | None = None,
    with_scale: bool = False,
    max_rounds: int = 100,
    tolerance: float = 1e-6,
    backend: str = "auto",
) -> ClosestPoints:
    """Bring each cloud onto its target by the nearest points as partners (ICP, point to point), all clouds at once.

    Every round moves the points, takes the nearest target of each within ``max_distance`` for its partner and fits the
    motion of :func:`fit_paired_points` anew, until the root of the mean square changes by less than ``tolerance`` of
    itself. A cloud that has converged stays as it is, so a batch is its clouds alone. It finds the nearest local
    minimum and slides along surfaces slowly; one pair of clouds is judged, by more methods, in
    :func:`pcdata.alignment.align_clouds`.

    Args:
        points: the clouds that move, in any unit of length.
        targets: where they go.
        ptr: row pointers of the points.
        targets_ptr: row pointers of the targets: cloud b goes to target b.
        initial: where to start.
        max_distance: of partners, in the points' unit; None = any.
        with_scale: one scale for all three axes is found too; with few partners it shrinks.
        max_rounds: at most.
        tolerance: as a part of the error.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        TooFewPointsError: a cloud of fewer than three points, or a target of none.
        PoseError: points with partners that determine no rotation, or none that has a partner.
        ConfigError: a parameter out of range.

    Source: Besl & McKay, A method for registration of 3-D shapes, IEEE TPAMI 14(2), 1992.
    """
    assert ptr is not None  # @op fills both
    assert targets_ptr is not None
    clouds, device = len(ptr) - 1, points.device
    identity = torch.eye(4, dtype=torch.float64, device=device).repeat(clouds, 1, 1)
    matrix = identity if initial is None else initial
    scale, overlap = identity[:, 0, 0], identity[:, 0, 0]
    rmse = torch.full((clouds,), torch.inf, dtype=torch.float64, device=device)
    open_ = torch.ones(clouds, dtype=torch.bool, device=device)
    for _ in range(max_rounds):
        moved = transform_points(points, ptr, matrix)
        index, _ = nearest_rows(
            targets, targets_ptr, 1, queries=moved, queries_ptr=ptr, radius=max_distance, backend=backend
        )
        found = index[:, 0] < len(targets)
        partners = targets[index[:, 0].clamp(max=len(targets) - 1)]
        try:
            fitted = fit_paired_points(points, partners, ptr, weights=found.float(), with_scale=with_scale)
        except PoseError as error:
            words = str(error).partition(": ")[2]
            raise PoseError(f"iterate_closest_points: {words}; or no partner lies within max_distance") from error
        matrix = torch.where(open_[:, None, None], fitted.matrix, matrix)
        scale = torch.where(open_, fitted.scale, scale)
        part = count_per_cloud(found, ptr).to(device).double() / counts_from_ptr(ptr)
        overlap = torch.where(open_, part, overlap)
        settled = (rmse - fitted.rmse).abs() <= tolerance * fitted.rmse
        rmse = torch.where(open_, fitted.rmse, rmse)
        open_ = open_ & ~settled
        if not bool(open_.any()):
            break
    return ClosestPoints(matrix, scale, rmse, overlap, ~open_)
