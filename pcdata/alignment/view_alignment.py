"""Rigid alignment of several views at once: one least-squares over the point-to-plane residuals of all pairs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pcdata.alignment.surface_descent import Step, descend
from pcdata.alignment.surfaces import Surface
from pcdata.errors import ConfigError, ShapeError
from pcdata.geometry import rigid
from pcdata.geometry.robust import TUKEY_CUT, robust_scale, robust_weights, unexplained_spread
from pcdata.geometry.small_motions import (
    PlaneSystem,
    TwistSolution,
    plane_system,
    solve_observable,
    twist_from_motion,
)

# Both directions of a pair measure the same surfaces with the same pixels.
_SHARED_DATA = 2.0
_WITHIN_NOISE = 0.25  # standard deviations
_SETTLED = 5e-5  # metres and radians: a hundredth of what fails


@dataclass(frozen=True, eq=False)
class PairFit:
    """How the samples of view ``source`` lie on the surface of view ``target``."""

    source: int
    target: int
    row: Tensor  # (M,) int64 of the source's samples, all captures one after the other
    residual: Tensor  # (M,) float64 metres, signed: positive in front of the target's surface
    points: Tensor  # (M, 3) float64 where, in the common frame
    num_samples: int  # of the source
    num_visible: int  # of them, that the target could see
    knows_visibility: bool  # of the target; False: every sample counts as visible
    system: PlaneSystem  # 6x6, of moving the source, whitened


@dataclass(frozen=True, eq=False)
class ViewAlignment:
    """The joint fit of V views; motions act in the common frame, ``aligned = motion @ world_from_view``."""

    motions: Tensor  # (V, 4, 4) float64; the identity for the view that was fixed
    twists: Tensor  # (V, 6) float64 of the motions about pivot: rotation vector, translation
    covariance: Tensor  # (6V, 6V) float64 of the twists, 0 for the fixed view and along unobservable directions
    unobservable: Tensor  # (M, 6V) float64, twists of all views together that were not moved along
    pivot: Tensor  # (3,) float64, the middle of the samples
    before: tuple[PairFit, ...]  # both directions of every pair, as given
    after: tuple[PairFit, ...]  # the same with the motions applied, at the last distance
    iterations: int
    converged: bool


def align_views(
    captures: Sequence[Sequence[Surface]],  # K captures of the same V views
    world_from_view: Tensor,  # (V, 4, 4) float64
    *,
    fixed: int = 0,
    max_distances: Sequence[float] = (0.06, 0.03, 0.015, 0.008, 0.004),
    max_angle: float = 0.6,
    max_iterations: int = 20,
) -> ViewAlignment:
    """Move all views but one so that their surfaces meet, over all pairs and captures in one least-squares.

    Gauss-Newton with Tukey's biweight, its scale measured per pair and round; a step goes only along directions that
    the surfaces determine together. Each scale ends when no view moves by more than 0.05 mm or 5e-5 radians, or
    by a quarter of the fit's own standard deviation.

    Args:
        captures: what each view saw; more captures of one rig add evidence.
        world_from_view: where the calibration says the views are.
        fixed: the view that stays.
        max_distances: metres between partners, coarse to fine; the first bounds the error that can be found.
        max_angle: radians between the normals of partners.
        max_iterations: per scale.

    Raises:
        ShapeError: not one surface and pose per view.
        ConfigError: there is no view ``fixed``.

    Source: Chen & Medioni 1992 for the residual; Pulli, Multiview registration for large data sets, 3DIM 1999, for
    solving all pairs together.
    """
    num_views = len(world_from_view)
    if not captures or any(len(capture) != num_views for capture in captures):
        raise ShapeError(f"align_views: every capture needs one surface per pose, {num_views}, and there must be one")
    if not 0 <= fixed < num_views:
        raise ConfigError(f"align_views: fixed must be a view, 0 to {num_views - 1}, got {fixed}")
    poses = world_from_view.double()
    pivot = scene_middle(captures, poses)
    motions = torch.eye(4, dtype=torch.float64, device=poses.device).repeat(num_views, 1, 1)
    before = measure_pairs(captures, poses, pivot, max_distances[0], max_angle)

    def measure(motions: Tensor, distance: float) -> Step:
        fits = measure_pairs(captures, motions @ poses, pivot, distance, max_angle)
        solution = _solve(fits, num_views, fixed)
        step = solution.twist.reshape(num_views, 6)
        # The Newton decrement is the step in standard deviations: what is left lies within the noise.
        decrement = float(solution.decrement) / _SHARED_DATA**0.5
        return step, decrement < _WITHIN_NOISE or float(step.abs().max()) < _SETTLED, _spread(fits)

    found = descend(measure, motions, pivot, max_distances, max_iterations=max_iterations)
    assessed = assess_motions(captures, poses, found.motions, pivot, fixed=fixed, max_distance=found.reach)
    return replace(assessed, before=before, iterations=found.iterations, converged=found.settled)


def assess_motions(
    captures: Sequence[Sequence[Surface]],
    world_from_view: Tensor,  # (V, 4, 4) float64
    motions: Tensor,  # (V, 4, 4) float64 in the common frame, however they were found
    pivot: Tensor,  # (3,) float64
    *,
    fixed: int,
    max_distance: float = 0.015,
) -> ViewAlignment:
    """Measure how well the moved views fit, and what the surfaces say about motions near these."""
    num_views = len(motions)
    poses = world_from_view.double()
    fits = measure_pairs(captures, motions @ poses, pivot, max_distance)
    solution = _solve(fits, num_views, fixed)
    return ViewAlignment(
        motions=motions,
        twists=twist_from_motion(motions, pivot),
        covariance=_SHARED_DATA * solution.covariance,
        unobservable=solution.unobservable,
        pivot=pivot,
        before=fits,
        after=fits,
        iterations=0,
        converged=True,
    )


def _spread(fits: Sequence[PairFit]) -> float:
    """Return the standard deviation of the residuals of all pairs, in metres."""
    return float(robust_scale(torch.cat([fit.residual for fit in fits])))


def measure_pairs(
    captures: Sequence[Sequence[Surface]],
    world_from_view: Tensor,  # (V, 4, 4) float64
    pivot: Tensor,  # (3,)
    max_distance: float,
    max_angle: float = 0.6,
) -> tuple[PairFit, ...]:
    """Compare every view's samples with every other view's surface, at the given poses."""
    pairs = itertools.permutations(range(len(world_from_view)), 2)
    return tuple(
        _measure(captures, world_from_view, source, target, pivot, max_distance, max_angle) for source, target in pairs
    )


def _measure(
    captures: Sequence[Sequence[Surface]],
    poses: Tensor,
    source: int,
    target: int,
    pivot: Tensor,
    max_distance: float,
    max_angle: float,
) -> PairFit:
    parts: list[tuple[Tensor, ...]] = []
    num_samples = num_visible = 0
    target_from_source = rigid.invert_rigid(poses[target]) @ poses[source]
    rotation, world_from_target = target_from_source[:3, :3], poses[target]
    for capture in captures:
        samples = capture[source].samples
        points = samples.points @ rotation.T + target_from_source[:3, 3]
        normals = samples.normals @ rotation.T
        found = capture[target].match(points, normals, max_distance=max_distance, max_angle=max_angle)
        sigma = (samples.sigma[found.row].square() + found.sigma.square()).sqrt()
        # The mean of both normals, each as heavy as it is certain, so that a noisy one feigns no relief.
        own, other = samples.normal_sigma[found.row] ** -2, found.normal_sigma**-2
        normal = torch.nn.functional.normalize(
            own[:, None] * normals[found.row] + other[:, None] * found.normals, dim=1
        )
        residual = (normal * found.offset).sum(1)
        parts.append((found.row + num_samples, residual, points[found.row], normal, sigma, (own + other).rsqrt()))
        num_samples += len(points)
        num_visible += found.num_visible
    row, residual, points, normals, sigma, tilt = (torch.cat(part) for part in zip(*parts))
    points = points @ world_from_target[:3, :3].T + world_from_target[:3, 3]
    normals = normals @ world_from_target[:3, :3].T
    unexplained = unexplained_spread(residual, sigma)
    # Tukey's cut is the distance of this scale, not the spread of the residuals: most of them lie on the table, which
    # fits however far the view slid along it, and would have the sides of the objects thrown out as outliers.
    cut = residual.new_tensor(max_distance / TUKEY_CUT)
    weights = robust_weights(residual, cut, "tukey") / (sigma.square() + unexplained.square())
    system = plane_system(points, normals, residual, weights, pivot=pivot, normal_sigma=tilt)
    knows_visibility = all(capture[target].knows_visibility for capture in captures)
    return PairFit(source, target, row, residual, points, num_samples, num_visible, knows_visibility, system)


def _solve(fits: Sequence[PairFit], num_views: int, fixed: int) -> TwistSolution:
    """Solve for all views but the fixed one, whose rows are 0 in the result."""
    joint = joint_system(fits, num_views)
    free = torch.tensor(
        [row for row in range(6 * num_views) if row // 6 != fixed], dtype=torch.int64, device=joint.gradient.device
    )
    part = PlaneSystem(joint.information[free][:, free], joint.gradient[free], joint.feigned[free][:, free])
    solution = solve_observable(part)
    twist = torch.zeros_like(joint.gradient)
    twist[free] = solution.twist
    covariance = torch.zeros_like(joint.information)
    covariance[free[:, None], free] = solution.covariance
    unobservable = torch.zeros(len(solution.unobservable), len(twist), dtype=twist.dtype, device=twist.device)
    unobservable[:, free] = solution.unobservable
    return TwistSolution(twist, covariance, unobservable, solution.decrement)


def joint_system(fits: Sequence[PairFit], num_views: int) -> PlaneSystem:
    """Add up the pairs: moving the target is moving the source the other way.

    Moving all views together changes nothing, so one of them has to be fixed before this can be solved.
    """
    device = fits[0].residual.device
    size = 6 * num_views
    information, feigned = torch.zeros(2, size, size, dtype=torch.float64, device=device)
    gradient = torch.zeros(size, dtype=torch.float64, device=device)
    for fit in fits:
        source, target = (slice(6 * view, 6 * view + 6) for view in (fit.source, fit.target))
        for total, part in ((information, fit.system.information), (feigned, fit.system.feigned)):
            total[source, source] += part
            total[target, target] += part
            total[source, target] -= part
            total[target, source] -= part
        gradient[source] += fit.system.gradient
        gradient[target] -= fit.system.gradient
    return PlaneSystem(information, gradient, feigned)


def scene_middle(captures: Sequence[Sequence[Surface]], poses: Tensor) -> Tensor:
    """Return the coordinate-wise median of all samples: where a turn moves the scene least."""
    moved = [
        surface.samples.points @ pose[:3, :3].T + pose[:3, 3]
        for capture in captures
        for surface, pose in zip(capture, poses)
    ]
    points = torch.cat(moved)
    return points.median(0).values if len(points) else poses.new_zeros(3)
