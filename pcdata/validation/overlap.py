"""Do the cameras agree? The gap between their surfaces, how far each is out of place, and which one is wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from pcdata.alignment.surfaces import Surface
from pcdata.alignment.view_alignment import PairFit, ViewAlignment, align_views
from pcdata.alignment.view_consensus import find_consensus, measured_part, sigma_along
from pcdata.errors import ConfigError, ShapeError
from pcdata.geometry.small_motions import motion_from_twist
from pcdata.structures import DepthFrame, PointCloud
from pcdata.threads import torch_on_one_thread
from pcdata.validation.measures.view_surfaces import surfaces_of
from pcdata.validation.overlap_result import CameraOverlap, OverlapLimits, OverlapResult, PairOverlap
from pcdata.verdicts import Verdict, judged, worst

_MIN_MATCHES = 100  # samples; a smaller overlap says nothing about six unknowns
_MAX_SAMPLES = 4000  # per view and capture: what two cores align well within a second
_MIN_MEETING = 0.3  # of the samples that the other camera could see, the share that it sees within reach


@torch_on_one_thread()
def verify_overlap(
    *captures: DepthFrame | PointCloud,
    names: Sequence[str] | None = None,
    limits: OverlapLimits | None = None,
    max_samples: int = _MAX_SAMPLES,
) -> OverlapResult:
    """Say whether the cameras of a rig see one and the same surface, and which of them does not.

    Every view is sampled at small fitted planes, evenly over the directions they face. Each pair gives the distances
    from the samples of the one to the planes of the other; where depth images are at hand only where the other camera
    could see them. Since a camera that slid along the table leaves those distances small, all views are also aligned
    together by ICP, and what that moves is each camera's error, with its uncertainty from the covariance of the fit.

    Args:
        captures: one capture or several of the same, unmoved cameras: frames of V >= 2 views with poses, or clouds
            with one cloud per view in a common frame. More captures add evidence.
        names: one per camera; None = "camera 0", "camera 1", ...
        limits: what passes and what fails; None = the defaults.
        max_samples: per view and capture.

    Raises:
        ShapeError: fewer than two views, or captures with different numbers of them.
        FrameError: the views are not in a common frame, or their poses are unknown or differ between the captures.
        UnitError: a cloud is not in metres.
        ConfigError: no capture, or not one name per camera.
    """
    where = "verify_overlap"
    limits = OverlapLimits() if limits is None else limits
    if not captures:
        raise ConfigError(f"{where}: give at least one capture")
    surfaces, poses = zip(*(surfaces_of(where, capture, max_samples=max_samples) for capture in captures))
    num_views = len(poses[0])
    for position, pose in enumerate(poses):
        if pose.shape != poses[0].shape or not torch.allclose(pose, poses[0], rtol=0, atol=1e-9):
            raise ShapeError(f"{where}: capture {position} has other cameras or poses than capture 0; give one rig")
    names = tuple(f"camera {view}" for view in range(num_views)) if names is None else tuple(names)
    if len(names) != num_views or len(set(names)) != num_views:
        raise ConfigError(f"{where}: give one name per camera, all different: {num_views} cameras, got {names}")
    found = judge_alignment(align_views(surfaces, poses[0]), names, limits)
    if num_views < 3 or not found.candidates:
        return found
    # A view that is far off spoils the fit of all by partners found by chance: look whether the rest agree without it.
    rests = {view: _without(view, surfaces, poses[0], names, limits) for view in range(num_views)}
    agreeing = [view for view, rest in rests.items() if rest.verdict in (Verdict.PASS, Verdict.UNKNOWN)]
    confirmed = {view: sum(pair.verdict is Verdict.PASS for pair in rests[view].pairs) for view in agreeing}
    best = [view for view in agreeing if confirmed[view] == max(confirmed.values())]
    return _far_off(best[0], found, rests[best[0]]) if len(best) == 1 and confirmed[best[0]] else found


def _without(
    view: int,
    captures: Sequence[Sequence[Surface]],
    poses: Tensor,
    names: Sequence[str],
    limits: OverlapLimits,
) -> OverlapResult:
    rest = [other for other in range(len(poses)) if other != view]
    alignment = align_views([[capture[other] for other in rest] for capture in captures], poses[rest])
    return judge_alignment(alignment, [names[other] for other in rest], limits)


def _far_off(view: int, joint: OverlapResult, rest: OverlapResult) -> OverlapResult:
    """Judge the others by the fit without this view; how far it is off cannot be told."""
    lost = replace(
        joint.cameras[view],
        shift=math.inf,
        shift_vector=(math.inf,) * 3,
        rotation_degrees=math.inf,
        correction=torch.eye(4, dtype=torch.float64, device="cpu").tolist(),
        unmeasurable=(),
        verdict=Verdict.FAIL,
    )
    cameras = [*rest.cameras[:view], lost, *rest.cameras[view:]]
    return replace(joint, cameras=tuple(cameras), wrong=(lost.name,), candidates=(), reference=rest.reference)


def judge_alignment(
    alignment: ViewAlignment, names: Sequence[str], limits: OverlapLimits, *, reference: int | None = None
) -> OverlapResult:
    """Turn a joint fit of the views into numbers per pair and per camera, a verdict and advice.

    Args:
        alignment: the joint fit.
        names: one per view.
        limits: what passes and what fails.
        reference: the view that the others are compared with; None = the best known of those that agree.
    """
    consensus = find_consensus(
        alignment,
        max_shift=limits.shift[0],
        max_angle=math.radians(limits.rotation_degrees[0]),
        reference=reference,
    )
    pairs = pairs_of(alignment.before, names, limits)
    suspects = consensus.wrong or consensus.candidates
    cameras = tuple(
        _camera(
            view,
            name,
            alignment,
            twist,
            covariance,
            limits,
            may_be_wrong=bool(consensus.candidates) and view in suspects,
        )
        for view, (name, twist, covariance) in enumerate(zip(names, consensus.twists, consensus.covariance))
    )
    return OverlapResult(
        pairs=pairs,
        cameras=cameras,
        wrong=tuple(names[view] for view in consensus.wrong),
        candidates=tuple(names[view] for view in consensus.candidates),
        reference=names[consensus.reference],
        limits=limits,
    )


def pairs_of(fits: Sequence[PairFit], names: Sequence[str], limits: OverlapLimits) -> tuple[PairOverlap, ...]:
    """Judge every two views by how they were measured, in both directions."""
    return tuple(_pair(one, _opposite(fits, one), names, limits) for one in fits if one.source < one.target)


def _pair(fit: PairFit, back: PairFit, names: Sequence[str], limits: OverlapLimits) -> PairOverlap:
    residual = torch.cat([fit.residual, -back.residual])
    size = residual.abs()
    visible = fit.num_visible + back.num_visible
    enough = len(residual) >= _MIN_MATCHES
    values = size.double().quantile(size.new_tensor([0.5, 0.9])).tolist() if enough else [math.nan, math.nan]
    meets = len(residual) / visible if visible else 0.0
    apart = visible >= _MIN_MATCHES and meets < _MIN_MEETING and fit.knows_visibility
    if apart:
        verdict = Verdict.FAIL
    elif not enough:
        verdict = Verdict.UNKNOWN
    else:
        verdict = judged(values[0], *limits.residual)
    return PairOverlap(
        first=names[fit.source],
        second=names[fit.target],
        overlap=len(residual) / max(fit.num_samples + back.num_samples, 1),
        meeting=meets if fit.knows_visibility else None,
        num_samples=len(residual),
        median=values[0],
        p90=values[1],
        mean=_trimmed_mean(residual) if enough else math.nan,
        verdict=verdict,
        histogram=tuple(torch.histc(residual.float(), 60, -0.015, 0.015).long().tolist()),
    )


def _camera(
    view: int,
    name: str,
    alignment: ViewAlignment,
    twist: Tensor,  # (6,) what would bring it onto the reference
    covariance: Tensor,  # (6, 6) of that
    limits: OverlapLimits,
    *,
    may_be_wrong: bool,
) -> CameraOverlap:
    seen = [fit.points for fit in alignment.after if view in (fit.source, fit.target)]
    points = torch.cat(seen)
    center = points.median(0).values if len(points) else alignment.pivot
    motion = motion_from_twist(twist, alignment.pivot)
    covariance = _at(center - alignment.pivot, covariance)
    shift_sigma, unknown_shifts = _spread(covariance[3:, 3:], limits.max_shift_sigma)
    turn_sigma, unknown_turns = _spread(covariance[:3, :3], math.radians(limits.max_rotation_sigma_degrees))
    unknown = (
        *(f"shift along {_words(direction)}" for direction in unknown_shifts),
        *(f"turn about {_words(direction)}" for direction in unknown_turns),
    )
    # What the surfaces do not determine may be anything, and must not accuse a camera.
    shift = motion[:3, :3] @ center + motion[:3, 3] - center
    shift = measured_part(shift, covariance[3:, 3:], limits.max_shift_sigma)
    turn = measured_part(twist[:3], covariance[:3, :3], math.radians(limits.max_rotation_sigma_degrees))
    degrees = math.degrees(float(turn.norm()))
    verdict = worst((judged(float(shift.norm()), *limits.shift), judged(degrees, *limits.rotation_degrees)))
    if verdict is Verdict.PASS and unknown:
        verdict = Verdict.UNKNOWN
    if may_be_wrong and verdict in (Verdict.PASS, Verdict.UNKNOWN):
        verdict = Verdict.WARN  # it may be this one as well as the other
    return CameraOverlap(
        name=name,
        shift=float(shift.norm()),
        shift_vector=tuple(shift.tolist()),
        shift_sigma=shift_sigma,
        measured_shift_sigma=sigma_along(shift, covariance[3:, 3:]),
        rotation_degrees=degrees,
        rotation_sigma_degrees=math.degrees(turn_sigma),
        measured_rotation_sigma_degrees=math.degrees(sigma_along(turn, covariance[:3, :3])),
        center=tuple(center.tolist()),
        correction=motion.tolist(),
        unmeasurable=unknown,
        verdict=verdict,
    )


def _opposite(fits: Sequence[PairFit], one: PairFit) -> PairFit:
    return next(fit for fit in fits if (fit.source, fit.target) == (one.target, one.source))


def _trimmed_mean(residual: Tensor) -> float:
    """Return the mean of the central 80 per cent."""
    cut = len(residual) // 10
    ordered = residual.sort().values
    return float(ordered[cut : len(ordered) - cut].mean())


def _at(arm: Tensor, covariance: Tensor) -> Tensor:
    """Move the covariance of a twist from its pivot to pivot + arm: t' = t + w x arm."""
    x, y, z = arm.tolist()
    moved = torch.eye(6, dtype=torch.float64, device=covariance.device)
    moved[3:, :3] = moved.new_tensor([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    return moved @ covariance @ moved.T


def _spread(covariance: Tensor, limit: float) -> tuple[float, list[Tensor]]:
    """Return the largest standard deviation, infinite where unknown, and the directions beyond the limit."""
    values, vectors = torch.linalg.eigh((covariance + covariance.T) / 2)
    sigma = values.clamp(min=0).sqrt()
    beyond = [vectors[:, k] for k in range(3) if float(sigma[k]) > limit]
    largest = float(sigma[-1])
    return (largest if largest < 0.1 else math.inf), beyond


def _words(direction: Tensor) -> str:
    leading = direction[direction.abs().argmax()]
    x, y, z = (float(value) + 0.0 for value in direction * leading.sign())
    return f"({x:.2f}, {y:.2f}, {z:.2f})"
