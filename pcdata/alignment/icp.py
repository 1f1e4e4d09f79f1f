"""Point-to-plane ICP: the rigid motion that brings one cloud onto another, and how far it can be trusted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pcdata.alignment.cloud_pair import MIN_MATCHES, NUM_FINE, CloudPair
from pcdata.alignment.surface_descent import Descent, Step, descend
from pcdata.contracts.numbers import require_count, require_length
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ConfigError, TooFewPointsError
from pcdata.functional.neighbors import knn
from pcdata.functional.normals import estimate_normals
from pcdata.geometry import rigid
from pcdata.geometry.robust import KERNELS
from pcdata.geometry.small_motions import motion_along

ANY_ANGLE = 2.0  # radians: beyond a quarter turn, so every pair of normals without sign agrees
_SMALL = 1e-6  # radians and units
_ENOUGH = 1e-3  # of a distance: finer ones follow
_MAX_SEARCHES = 4  # after the first; better poses than these find are out of reach
_BEND = 0.1  # of the mean weight
_BETTER = 0.01  # of the fitted share: less is the noise of the matching
_ROUNDS_BACK = 5  # Gauss-Newton on a quadratic: the second is exact for slides, turns of half a radian take four
_NEAR = 3.0  # times the last distance
_MIN_SUPPORT = 0.5  # most of what is near has to be on the surface
_CHANCE = 0.5  # of the distance; evenly spread residuals have 1 / sqrt(3) = 0.58
_NORMAL_RADIUS = 0.02  # metres for clouds in metres: a depth camera's noise at 1 m tilts such normals by 2 degrees
_NORMAL_SPACINGS = 4.0  # times the median distance of neighbors: a dozen points on a surface
_LEAST_WIDTH = 0.1  # of the last distance
_MOST_OPEN = 3  # directions: a plane's, a sphere's


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where a source cloud lies in a target's frame, and how far that can be trusted."""

    target_from_source: Tensor  # (4, 4) float64 rigid
    rmse: float  # of the point-to-plane residuals that overlap at the last distance, in the points' unit; inf = none do
    overlap: float  # share of the source points that have a partner, 0..1
    support: float  # of the source points within three times the last distance of the target, the share with a partner
    iterations: int  # over all scales and searches
    converged: bool  # the steps had become small, the surfaces meet there, and a wider search found no better pose
    reason: str  # why not converged, in words; empty where it is
    unobservable: (
        Tensor  # (M, 6) float64 twists about pivot that the surfaces leave open at this pose: rotation vector,
    )
    #   translation. Of the poses that differ by these alone, this is the one nearest to the start.
    covariance: Tensor  # (6, 6) float64 of the twist about pivot, 0 along the unobservable directions
    pivot: Tensor  # (3,) float64, in the target's frame


def icp_point_to_plane(
    source: Tensor,  # (N, 3) float32
    target: Tensor,  # (M, 3) float32
    *,
    target_normals: Tensor | None = None,  # (M, 3) unit; None = estimated within normal_radius
    source_normals: Tensor | None = None,  # (N, 3) unit; None = estimated; partners must have similar normals
    initial: Tensor | None = None,  # (4, 4) target_from_source; None = the identity
    max_distances: Sequence[float] | None = None,  # None = by the clouds
    kernel: str = "tukey",
    scale: float | None = None,
    max_normal_angle: float = 0.6,
    normal_radius: float | None = None,
    max_iterations: int = 30,
) -> Alignment:
    """Find the rigid motion that brings one cloud onto the surface of another, and say whether it can be trusted.

    Each round pairs every source point with its nearest target point (closer than the scale's distance, normals within
    ``max_normal_angle``; the widest of several scales does not compare normals, which a turned start would spoil),
    weighs the point-to-plane residuals and takes a Gauss-Newton step. The last scale ends when the step is below 1e-6
    radians and 1e-6 units or a twentieth of its standard deviation, the others below a thousandth of their distance,
    all after ``max_iterations``. All sums are float64.

    Searches start at the given pose with all scales and with the finest alone, and again with all scales at the pose
    that they found. The best is kept: the one that brings the most source points onto the target within the last
    distance. Which directions the surfaces determine is judged there, not on the way, where normals differ because the
    clouds are apart.

    The result says ``converged=False`` with its reason where the last steps were not small, the clouds ceased to
    overlap on the way, fewer than half of the source points near the target lie on it, the residuals fill the search
    distance as chance would, no direction is determined, or wider searches still find better poses.

    Args:
        source: the cloud that moves; thousands of points are enough.
        target: the cloud that stays.
        target_normals: the target's normals, any sign.
        source_normals: the source's normals, any sign.
        initial: where to start.
        max_distances: the largest distance of partners at each scale, coarse to fine, in the points' unit. The first
            bounds the error that can be found. None = 0.05, 0.02 and 0.01, none of them less than twice the spacing of
            the target's points; before them 0.1, 0.2, ... up to twice the median distance between the clouds as they
            start, but no wider than the target.
        kernel: "tukey", "huber", "trimmed" (the smaller 80 per cent) or "none".
        scale: standard deviation of a good residual, for Tukey and Huber; None = each scale's distance / 4.685, where
            Tukey's weight reaches 0. The spread of the residuals would be no good guide: on a table most of them are
            small however far the cloud slid along it, and would have the sides of the objects thrown out.
        max_normal_angle: in radians.
        normal_radius: neighborhood of the estimated normals, in the points' unit; None = 0.02, but no less than four
            times the spacing of the points.
        max_iterations: per scale.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError, PoseError: an argument breaks the contract above.
        ConfigError: distances that do not descend, an unknown kernel, a count or length that is not positive, or a
            normal_radius that holds fewer than three points at most points.
        TooFewPointsError: a cloud of fewer than 20 points, or fewer than 20 source points overlap the target at the
            start.

    Source: Chen & Medioni, Object modeling by registration of multiple range images, 1992.
    """
    where = "icp_point_to_plane"
    _check_schedule(where, max_distances, kernel, scale, max_iterations)
    check_tensors(where, {"source": source, "target": target}, {"source": "N 3", "target": "M 3"})
    pose = torch.eye(4, dtype=torch.float64, device=source.device) if initial is None else initial.double()
    rigid.check_rigid(f"{where}: initial", pose)
    for name, cloud in (("source", source), ("target", target)):
        if len(cloud) < MIN_MATCHES:
            raise TooFewPointsError(f"{where}: {name} has {len(cloud)} points; at least {MIN_MATCHES} must overlap")
    if target_normals is None:
        target_normals = normals_of(where, "target", target, normal_radius)
    if source_normals is None:
        source_normals = normals_of(where, "source", source, normal_radius)
    pair = CloudPair(source, source_normals, target, target_normals, kernel, scale, max_normal_angle)
    distances = pair.distances_for(pose) if max_distances is None else tuple(max_distances)
    found = pair.match(pose, distances[0], ANY_ANGLE if len(distances) > 1 else max_normal_angle)
    if len(found.residual) < MIN_MATCHES:
        raise TooFewPointsError(
            f"{where}: only {len(found.residual)} of {len(source)} source points have a target point within "
            f"{distances[0]:g}; give a better initial pose, a larger first distance, or clouds that overlap"
        )
    pivot = pair.moved(pose).double().mean(0)

    def search(start: Tensor, distances: Sequence[float], num_open: int | None = None) -> Descent:
        def measure(motions: Tensor, distance: float) -> Step | None:
            angle = ANY_ANGLE if distance == distances[0] and len(distances) > 1 else max_normal_angle
            enough = _SMALL if distance == distances[-1] else _ENOUGH * distance
            return pair.step(motions[0] @ start, distance, angle, pivot, num_open, enough)

        start_of_all = torch.eye(4, dtype=torch.float64, device=source.device)[None]
        done = descend(measure, start_of_all, pivot, distances, max_iterations=max_iterations)
        return replace(done, motions=done.motions @ start)

    finest = distances[-1]
    best, gain = search(pose, distances), 0.0
    iterations = best.iterations
    starts = [(pose, tuple(distances[-NUM_FINE:]))] if len(distances) > NUM_FINE else []
    for _ in range(_MAX_SEARCHES):
        start, scales = starts.pop() if starts else (best.motions[0], distances)
        other = search(start, scales)
        iterations += other.iterations
        gain = -1.0 if other.lost else pair.gain(other.motions[0], best.motions[0], finest)
        best = other if gain > 0 else best
        if gain <= _BETTER and scales is distances:
            break
    num_open = pair.num_open(best.motions[0], finest, pivot)
    left_open = pair.solve(best.motions[0], finest, pivot, num_open=num_open)
    if left_open is not None and num_open:
        held = search(
            _nearest_along(left_open.unobservable, best.motions[0], pose, source, pivot), distances[-1:], num_open
        )
        iterations += held.iterations
        # Over so long a way a surface that is flat here may bend: then the found pose stays. Fewer partners are none.
        if not held.lost and pair.gain(held.motions[0], best.motions[0], finest, per_partner=True) > -_BEND:
            best = held
    return judged(pair, best, pivot, finest, iterations, num_open, still_better=gain > _BETTER)


def _nearest_along(directions: Tensor, pose: Tensor, start: Tensor, source: Tensor, pivot: Tensor) -> Tensor:
    """Return the pose that moves the points least from the start, of those that differ by the directions (M, 6)."""
    points = source.double()
    goal = points @ start[:3, :3].T + start[:3, 3]
    for _ in range(_ROUNDS_BACK):
        arm = points @ pose[:3, :3].T + pose[:3, 3] - pivot
        moves = torch.linalg.cross(directions[:, None, :3], arm[None], dim=-1) + directions[:, None, 3:]  # (M, N, 3)
        moves = moves.flatten(1)
        amount = torch.linalg.pinv(moves @ moves.T, hermitian=True) @ (moves @ (goal - pivot - arm).flatten())
        pose = motion_along(amount @ directions, pivot) @ pose
    return pose


def judged(
    pair: CloudPair,
    descent: Descent,
    pivot: Tensor,
    distance: float,
    iterations: int,
    num_open: int,
    *,
    still_better: bool,
) -> Alignment:
    """Measure the result at its pose and say why it could not be trusted."""
    pose = descent.motions[0]
    found = pair.match(pose, distance)
    near = int((knn(pair.target, k=1, queries=pair.moved(pose))[1][:, 0] < _NEAR * distance).sum())
    support = len(found.residual) / max(near, 1)
    rmse = float(found.residual.square().mean().sqrt()) if len(found.residual) else math.inf
    solution = pair.solve(pose, distance, pivot, num_open=num_open)
    identity = torch.eye(6, dtype=torch.float64, device=pose.device)
    unobservable = identity if solution is None else solution.unobservable
    covariance = torch.zeros_like(identity)
    if solution is not None:
        weights = pair.weights(found, distance)
        squared = (weights * found.residual.square()).sum() / weights.sum().clamp(min=1e-300)
        covariance = solution.covariance * squared
    reason = ""
    if descent.lost or solution is None:
        reason = f"fewer than {MIN_MATCHES} source points kept a partner within {distance:g}"
    elif support < _MIN_SUPPORT:
        reason = (
            f"of {near} source points within {_NEAR * distance:g} of the target {len(found.residual)} lie on it "
            f"within {distance:g}: the clouds are near each other but do not meet"
        )
    elif len(unobservable) > _MOST_OPEN or pair.width(found) < _LEAST_WIDTH * distance:
        reason = "the points that meet lie in one place or on one line, or have no normals: no surface, no pose"
    elif rmse > _CHANCE * distance:
        reason = f"residuals of {rmse:.3g} fill the search distance of {distance:g} as chance would"
    elif still_better:
        reason = f"searching again from the result kept finding better poses, {_MAX_SEARCHES} times"
    elif not descent.settled:
        reason = f"steps had not become small after {descent.iterations} rounds; allow more iterations"
    return Alignment(
        target_from_source=pose,
        rmse=rmse,
        overlap=len(found.residual) / len(pair.source),
        support=support,
        iterations=iterations,
        converged=not reason,
        reason=reason,
        unobservable=unobservable,
        covariance=covariance,
        pivot=pivot,
    )


def normals_of(where: str, name: str, points: Tensor, radius: float | None) -> Tensor:
    """Estimate normals from neighborhoods that hold enough points; without neighbors all would be (0, 0, 1)."""
    distance = knn(points, k=3, queries=points)[1]  # to itself, the nearest, the next
    if radius is None:
        return estimate_normals(points, radius=max(_NORMAL_RADIUS, _NORMAL_SPACINGS * float(distance[:, 1].median())))
    require_length(where, "normal_radius", radius)
    third = float(distance[:, 2].median())
    if third >= radius:
        raise ConfigError(
            f"{where}: within normal_radius {radius:g} most points of the {name} have fewer than two neighbors, which "
            f"give no normal; give more than {third:.3g}, None, or the normals themselves"
        )
    return estimate_normals(points, radius=radius)


def _check_schedule(
    where: str, max_distances: Sequence[float] | None, kernel: str, scale: float | None, max_iterations: int
) -> None:
    require_count(where, "max_iterations", max_iterations)
    if max_distances is not None:
        for distance in max_distances:
            require_length(where, "max_distances", distance)
        if not len(max_distances) or list(max_distances) != sorted(max_distances, reverse=True):
            raise ConfigError(
                f"{where}: max_distances go from coarse to fine, at least one, got {tuple(max_distances)}"
            )
    if scale is not None:
        require_length(where, "scale", scale)
    if kernel not in KERNELS:
        raise ConfigError(f"{where}: kernel must be one of {', '.join(KERNELS)}, got {kernel!r}")
