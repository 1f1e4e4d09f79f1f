"""Rigid registration of two clouds: point-to-plane residuals on their overlap, and point-to-plane ICP."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.checks import check_tensors
from pcdata.errors import ConfigError, TooFewPointsError
from pcdata.functional import rigid
from pcdata.functional.neighbors import knn
from pcdata.functional.normals import estimate_normals
from pcdata.functional.parameters import require_count, require_length
from pcdata.functional.ragged import ptr_from_counts
from pcdata.functional.robust import KERNELS, TUKEY_CUT, robust_weights
from pcdata.functional.small_motions import PlaneSystem, motion_from_twist, plane_system, solve_observable

_MIN_MATCHES = 20  # fewer cannot carry six unknowns and a robust scale
_MIN_NORMAL_NOISE = 0.01  # radians; no estimated normal is better, and exact data should not divide by 0
# The median angle between two directions that each err by s along both tangents is sqrt(2) sqrt(2 ln 2) s = 1.665 s.
_MEDIAN_ANGLE = 1.665


@dataclass(frozen=True, eq=False)
class PlaneResiduals:
    """Signed distances of source points to the target's tangent planes, where the two overlap."""

    residual: Tensor  # (M,) in the points' unit: target normal . (source point - target point)
    source_index: Tensor  # (M,) int64 rows of the source, ascending
    target_index: Tensor  # (M,) int64 rows of the target


@dataclass(frozen=True, eq=False)
class Registration:
    """Where a source cloud lies in a target's frame, and how far that can be trusted."""

    target_from_source: Tensor  # (4, 4) float64 rigid
    rmse: float  # of the point-to-plane residuals that overlap at the last distance, in the points' unit
    overlap: float  # share of the source points that have a partner, 0..1
    iterations: int  # over all scales
    converged: bool  # the last scale stopped because the steps had become small
    unobservable: Tensor  # (M, 6) float64 twists about pivot that were not moved along: rotation vector, translation
    covariance: Tensor  # (6, 6) float64 of the twist about pivot, 0 along the unobservable directions
    pivot: Tensor  # (3,) float64, in the target's frame


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
        agree = rigid.angle_between(source_normals[rows], _facing(target_normals[partner], source_normals[rows]))
        alike = agree < max_normal_angle
        rows, partner = rows[alike], partner[alike]
    offset = source[rows].double() - target[partner].double()
    residual = (offset * target_normals[partner].double()).sum(1)
    return PlaneResiduals(residual, rows, partner)


def icp_point_to_plane(
    source: Tensor,  # (N, 3) float32
    target: Tensor,  # (M, 3) float32
    *,
    target_normals: Tensor | None = None,  # (M, 3) unit; None = estimated within normal_radius
    source_normals: Tensor | None = None,  # (N, 3) unit; None = estimated; partners must have similar normals
    initial: Tensor | None = None,  # (4, 4) target_from_source; None = the identity
    max_distances: Sequence[float] = (0.05, 0.02, 0.01),
    kernel: str = "tukey",
    scale: float | None = None,
    max_normal_angle: float = 0.6,
    normal_radius: float = 0.02,
    max_iterations: int = 30,
) -> Registration:
    """Find the rigid motion that brings one cloud onto the surface of another, from a nearby start.

    Each round pairs every source point with its nearest target point (closer than the scale's distance, normals within
    ``max_normal_angle``), weighs the point-to-plane residuals and takes a Gauss-Newton step along the directions that
    the surfaces determine. A scale ends when the step is below 1e-6 radians and 1e-6 units, or after
    ``max_iterations``. All sums are float64.

    Args:
        source: the cloud that moves; thousands of points are enough.
        target: the cloud that stays.
        target_normals: the target's normals, any sign.
        source_normals: the source's normals, any sign.
        initial: where to start.
        max_distances: the largest distance of partners at each scale, coarse to fine, in the points' unit.
        kernel: "tukey", "huber", "trimmed" (the smaller 80 per cent) or "none".
        scale: standard deviation of a good residual, for Tukey and Huber; None = each scale's distance / 4.685, where
            Tukey's weight reaches 0. The spread of the residuals would be no good guide: on a table most of them are
            small however far the cloud slid along it, and would have the sides of the objects thrown out.
        max_normal_angle: in radians.
        normal_radius: neighbourhood of the estimated normals, in the points' unit.
        max_iterations: per scale.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError, PoseError: an argument breaks the contract above.
        ConfigError: distances that do not descend, an unknown kernel, a count or length that is not positive.
        TooFewPointsError: fewer than 20 source points overlap the target.

    Source: Chen & Medioni, Object modelling by registration of multiple range images, 1992.
    """
    where = "icp_point_to_plane"
    _check_schedule(where, max_distances, kernel, scale, max_iterations)
    check_tensors(where, {"source": source, "target": target}, {"source": "N 3", "target": "M 3"})
    if target_normals is None:
        target_normals = estimate_normals(target, radius=normal_radius)
    if source_normals is None:
        source_normals = estimate_normals(source, radius=normal_radius)
    pose = torch.eye(4, dtype=torch.float64, device=source.device) if initial is None else initial.double()
    rigid.check_rigid(f"{where}: initial", pose)
    one_cloud = torch.tensor([0, len(source)], dtype=torch.int64, device=source.device)
    options = {"max_normal_angle": max_normal_angle}

    def measure(distance: float) -> tuple[Tensor, PlaneResiduals, PlaneSystem, Tensor]:
        moved = rigid.transform_points(source, one_cloud, pose[None])
        turned = rigid.transform_directions(source_normals, one_cloud, pose[None])
        found = point_to_plane_residuals(
            moved, target, target_normals, max_distance=distance, source_normals=turned, **options
        )
        if len(found.residual) < _MIN_MATCHES:
            raise TooFewPointsError(
                f"{where}: only {len(found.residual)} of {len(source)} source points have a target point within "
                f"{distance:g}; give a better initial pose, a larger first distance, or clouds that overlap"
            )
        points = moved[found.source_index].double()
        normals = target_normals[found.target_index].double()
        pivot = points.mean(0)
        sigma = found.residual.new_tensor(distance / TUKEY_CUT if scale is None else scale)
        noise = _normal_noise(turned[found.source_index], normals)
        weights = robust_weights(found.residual, sigma, kernel)
        system = plane_system(points, normals, found.residual, weights, pivot=pivot, normal_sigma=noise)
        return pivot, found, system, weights

    iterations, converged = 0, False
    for distance in max_distances:
        converged = False
        for _ in range(max_iterations):
            pivot, found, system, weights = measure(distance)
            solution = solve_observable(system)
            pose = motion_from_twist(solution.twist, pivot) @ pose
            iterations += 1
            if float(solution.twist.abs().max()) < 1e-6:
                converged = True
                break
    pivot, found, system, weights = measure(max_distances[-1])
    solution = solve_observable(system)
    squared = (weights * found.residual.square()).sum() / weights.sum()
    return Registration(
        target_from_source=pose,
        rmse=float(found.residual.square().mean().sqrt()),
        overlap=len(found.residual) / len(source),
        iterations=iterations,
        converged=converged,
        unobservable=solution.unobservable,
        covariance=solution.covariance * squared,
        pivot=pivot,
    )


def _normal_noise(normals: Tensor, partners: Tensor) -> float:
    """Return how far normals err along each tangent, in radians, from the median angle between (M, 3) partners."""
    if len(normals) == 0:
        return _MIN_NORMAL_NOISE
    angle = rigid.angle_between(normals, _facing(partners, normals))
    return max(float(angle.median()) / _MEDIAN_ANGLE, _MIN_NORMAL_NOISE)


def _facing(normals: Tensor, reference: Tensor) -> Tensor:
    """Turn normals (M, 3) to the side of the reference normals."""
    return torch.where((normals * reference).sum(-1, keepdim=True) < 0, -normals, normals)


def _check_schedule(
    where: str, max_distances: Sequence[float], kernel: str, scale: float | None, max_iterations: int
) -> None:
    require_count(where, "max_iterations", max_iterations)
    for distance in max_distances:
        require_length(where, "max_distances", distance)
    if not max_distances or list(max_distances) != sorted(max_distances, reverse=True):
        raise ConfigError(f"{where}: max_distances go from coarse to fine, at least one, got {tuple(max_distances)}")
    if scale is not None:
        require_length(where, "scale", scale)
    if kernel not in KERNELS:
        raise ConfigError(f"{where}: kernel must be one of {', '.join(KERNELS)}, got {kernel!r}")
