"""The motion between points whose partners are known."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.errors import ConfigError, DTypeError, PoseError, ShapeError
from pcdata.functional.rows import cloud_of_rows

_ROUNDING = 4.0  # times that of the coordinates, which lets points of one line seem to spread aside


class PairedMotion(NamedTuple):
    """Where the points of each cloud go."""

    matrix: Tensor  # (B, D+1, D+1) float64, target from point: scale times rotation, and translation
    scale: Tensor  # (B,) float64, 1 without scale
    rmse: Tensor  # (B,) float64, weighted, in the points' unit


def checked_flag(where: str, name: str, arguments: Mapping[str, Any]) -> bool:
    """Require True or False."""
    if not isinstance(arguments[name], bool):
        raise DTypeError(f"{where}: {name} must be True or False, not {type(arguments[name]).__name__}")
    return bool(arguments[name])


@op(points="N D : float", targets="N D : float", weights="N : float", ptr="ptr N B >= 3", with_scale=checked_flag)
def fit_paired_points(
    points: Tensor,  # (N, D) float32 or float64
    targets: Tensor,  # (N, D): row n is the partner of point n
    ptr: Tensor | None = None,  # (B+1,)
    *,
    weights: Tensor | None = None,  # (N,) at least 0; None = 1 each
    with_scale: bool = False,
    backend: str = "auto",
) -> PairedMotion:
    """Find, for every cloud, the rigid motion (or similarity) that brings its points nearest to their partners.

    It minimizes the weighted sum of squared distances, exactly, in float64, and is never a reflection. Three columns
    are points in space, two are points in a plane; any number from two on will do. Gradients flow to points, targets
    and weights.

    Raises:
        TooFewPointsError: a cloud of fewer than three points.
        PoseError: points or partners of a cloud lie on one line or in one place, or so that two rotations fit alike.
        ConfigError: a weight below 0.
        ShapeError: one column.

    Source: Kabsch, 1976; Umeyama, Least-squares estimation of transformation parameters, 1991.
    """
    assert ptr is not None
    where = "fit_paired_points"
    clouds, cloud, columns = len(ptr) - 1, cloud_of_rows(ptr), points.shape[1]
    if columns < 2:
        raise ShapeError(f"{where}: points need two columns or more to turn in, got {tuple(points.shape)}")
    weight = torch.ones(len(points), dtype=torch.float64, device=points.device) if weights is None else weights.double()
    if bool((weight < 0).any()):
        raise ConfigError(f"{where}: weights must be at least 0, got {float(weight.min()):g}")

    def total(values: Tensor) -> Tensor:
        return values.new_zeros(clouds, *values.shape[1:]).index_add(0, cloud, values)

    mass = total(weight)
    safe = torch.where(mass > 0, mass, 1.0)
    share = (weight / safe[cloud])[:, None]
    a, b = points.double(), targets.double()
    mean_a, mean_b = total(share * a), total(share * b)
    a, b = a - mean_a[cloud], b - mean_b[cloud]
    covariance = total(share[..., None] * b[:, :, None] * a[:, None, :])  # (B, D, D), target by point
    spread_a, spread_b = total(share[:, 0] * a.square().sum(1)), total(share[:, 0] * b.square().sum(1))
    left, values, right = torch.linalg.svd(covariance)
    sign = torch.where(torch.linalg.det(left) * torch.linalg.det(right) < 0, -1.0, 1.0).detach()
    # Two rotations fit alike where the last value but one and the last, with its sign, cancel but for rounding.
    noise_a = _ROUNDING * torch.finfo(points.dtype).eps * (mean_a.square().sum(1) + spread_a).sqrt()
    noise_b = _ROUNDING * torch.finfo(targets.dtype).eps * (mean_b.square().sum(1) + spread_b).sqrt()
    unsure = values[:, -2] + sign * values[:, -1] <= noise_a * spread_b.sqrt() + noise_b * spread_a.sqrt()
    if bool(unsure.any()):
        raise PoseError(
            f"{where}: no rotation is determined for cloud {int(unsure.nonzero()[0])}: its points or their partners "
            "do not spread (in space over a plane, in a plane over a line), or two rotations fit alike; "
            "give points that do"
        )
    flips = torch.cat([sign.new_ones(clouds, columns - 1), sign[:, None]], dim=1)
    rotation = (left * flips[:, None]) @ right
    fitted = (values * flips).sum(1)
    scale = fitted / spread_a if with_scale else torch.ones_like(fitted)
    linear = scale[:, None, None] * rotation
    shift = mean_b - (linear @ mean_a[..., None])[..., 0]
    last = linear.new_tensor([0.0] * columns + [1.0]).expand(clouds, 1, columns + 1)
    matrix = torch.cat([torch.cat([linear, shift[..., None]], dim=2), last], dim=1)
    squares = (spread_b + scale * (scale * spread_a - 2 * fitted)).clamp(min=0)
    exact = squares <= 1e-30 * spread_b  # a root has no slope at 0
    return PairedMotion(matrix, scale, torch.where(exact, 0.0, torch.where(exact, 1.0, squares).sqrt()))
