"""The dominant plane of a cloud by RANSAC, refined to the least-squares plane of its own inliers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count, checked_length
from pcdata.contracts.on_host import counts_of
from pcdata.errors import NoPlaneError
from pcdata.functional.plane_arguments import (
    checked_guess,
    checked_probability,
    checked_seeds,
    checked_tilt,
    checked_up,
)
from pcdata.functional.plane_steps import record_planes, refine_planes, search_planes, within_tilt
from pcdata.functional.row_draws import draw_rows
from pcdata.geometry.plane_fit import planes_through, through_origin
from pcdata.rng import seeded

# Points that hypotheses are scored on where they need not be the best of all: their shares are off by 0.4 % or less.
SCORED_BITS, _ALL_BITS = 14, 62
# Planes drawn at a time, over all clouds: 32 MB.
MOST_HYPOTHESES = 1 << 20


@op(
    points="N 3",
    ptr="ptr N B >= 3",
    distance=checked_length,
    num_hypotheses=checked_count,
    seed=checked_seeds,
    up=checked_up,
    max_tilt=checked_tilt,
    probability=checked_probability,
    guess=checked_guess,
    steps=(record_planes, search_planes, refine_planes),
    gradient=False,
)
def ransac_plane(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,)
    *,
    distance: float = 0.01,
    num_hypotheses: int = 1000,
    seed: int | Sequence[int] | Tensor = 0,
    up: Tensor | Sequence[float] | None = None,
    max_tilt: float | None = None,
    probability: float | None = None,
    guess: Tensor | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # planes (B, 4) float64, inlier_mask (N,) bool
    """Find each cloud's plane with the most points nearer than ``distance`` (strictly, as Open3D).

    A plane is (nx, ny, nz, d) with a unit normal and n.p + d = 0. Every hypothesis is scored, on all points unless
    ``probability`` is given; ties go to the earliest. The winner is then refitted to its inliers by least squares until
    the inliers no longer change (at most 20 rounds).

    ``inlier_mask`` is ``|((nx*x + ny*y) + nz*z) + d| < distance`` in float32, with the plane rounded to float32.
    The normal points along ``up`` when given, else toward the origin, where the sensor is (d >= 0). A plane nearer to
    the origin than ``distance`` has no such side: its normal's largest component is positive; noise does not decide.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        distance: in the unit of the points.
        num_hypotheses: planes to try, each through three distinct random points.
        seed: of the triples; one for every cloud, so that a batch equals its clouds alone, or one per cloud.
        up: (3,) or one per cloud (B, 3); any length.
        max_tilt: radians; only planes whose normal is within this angle of up or -up compete. A refinement that would
            leave this cone is not taken.
        probability: stop at the first hypothesis by which, if the best so far holds the share w of the points, three
            points within that plane have been drawn with this probability: after log(1 - probability) /
            log(1 - w^3) tries. Hypotheses count in the order drawn, so every backend stops at the same. They are scored
            on 16,384 points at most, one out of each of as many equal stretches of the cloud (on all where no plane has
            3 of those); the winner is refitted to all. None = try all.
        guess: (B, 4) planes that compete before those drawn, such as those of the frame before; NaN = none. They are
            scored like the others, so a wrong one loses and changes nothing; they are not counted as tries.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        TooFewPointsError: a cloud has fewer than 3 points.
        NoPlaneError: no hypothesis is a plane (all points on a line) within the tilt limit.
        ConfigError: a parameter out of range, or ``max_tilt`` without ``up``.

    Source: Fischler & Bolles, CACM 24(6), 1981.
    """
    assert ptr is not None  # @op fills it
    assert isinstance(seed, list)  # and makes it one per cloud,
    assert up is None or isinstance(up, Tensor)  # and unit vectors
    num_clouds, counts = len(ptr) - 1, counts_of(ptr)
    # Hypotheses of many clouds at a time, so that memory does not grow with their number.
    at_once = max(1, MOST_HYPOTHESES // num_hypotheses)
    winners = []
    for first in range(0, num_clouds, at_once):
        some = slice(first, min(first + at_once, num_clouds))
        own, own_ptr = clouds_between(points, ptr, some.start, some.stop)
        hypotheses = _draw_planes(own, own_ptr, counts[some], num_hypotheses, seed[some])
        if guess is not None:
            hypotheses = torch.cat([guess[some, None], hypotheses], 1)
        is_plane = ~hypotheses[..., 0].isnan()
        competes = is_plane & within_tilt(hypotheses, None if up is None else up[some, None], max_tilt)
        if probability is None:
            floors = torch.zeros(len(own_ptr) - 1, dtype=torch.int64, device="cpu")
            near = record_planes(own, own_ptr, hypotheses, competes, distance, floors, backend=backend)
        else:
            search = distance, probability, hypotheses.shape[1] - num_hypotheses
            near = search_planes(own, own_ptr, hypotheses, competes, *search, SCORED_BITS, backend=backend)
            for b in (near.amax(1) < 3).nonzero().squeeze(1).tolist():
                alone = *clouds_between(own, own_ptr, b, b + 1), hypotheses[b : b + 1], competes[b : b + 1]
                near[b] = search_planes(*alone, *search, _ALL_BITS, backend=backend)[0]
        winners.append(_best_planes(hypotheses, is_plane, competes, near, distance, first))
    planes, inliers = refine_planes(points, ptr, torch.cat(winners), distance, up, max_tilt, backend=backend)
    return face_planes(planes, up, distance).to(points.device), inliers


def _draw_planes(points: Tensor, ptr: Tensor, counts: list[int], num_hypotheses: int, seeds: list[int]) -> Tensor:
    """Return planes through random triples of each cloud's points, (B, P, 4) float64 on the CPU, as planes_through."""
    asked = list(zip(counts, seeds))
    drawn = {key: draw_rows(key[0], 3, num_hypotheses, seeded(key[1])) for key in set(asked)}
    rows = torch.stack([drawn[key] for key in asked]) + ptr[:-1].cpu()[:, None, None]
    return planes_through(points[rows.to(points.device)].cpu())


def _best_planes(
    planes: Tensor, is_plane: Tensor, competes: Tensor, counts: Tensor, distance: float, first_cloud: int
) -> Tensor:
    """Return each cloud's plane with the most inliers, the earliest among equals, (B, 4)."""
    best = counts.argmax(1)  # the first of equals, as torch documents
    found = torch.stack([is_plane.sum(1), competes.sum(1), counts.gather(1, best[:, None]).squeeze(1)], 1)
    require_planes(found.tolist(), planes.shape[1], distance, first_cloud)
    return planes[torch.arange(len(planes), dtype=torch.int64, device="cpu"), best]


def require_planes(found: Sequence[tuple[int, ...]], tried: int, distance: float, first_cloud: int) -> None:
    """Refuse clouds without a plane.

    Args:
        found: of each cloud, how many of the hypotheses are planes, how many of those compete, and how many points are
            near the best. The first two matter where the third is less than 3.
        tried: hypotheses about each cloud.
        distance: from a plane.
        first_cloud: the number of the first of these.
    """
    if min([near for _, _, near in found]) >= 3:
        return
    for cloud, (planes, competing, near) in enumerate(found):
        if near < 3 and competing == 0:
            reason = (
                f"none of the {planes} planes found is within max_tilt of up; is up in the frame of the cloud?"
                if planes
                else f"all {tried} triples drawn lie on a line"
            )
            raise NoPlaneError(f"ransac_plane: cloud {first_cloud + cloud}: {reason}")
    for cloud, (_, _, near) in enumerate(found):
        if near < 3:
            raise NoPlaneError(
                f"ransac_plane: cloud {first_cloud + cloud}: no plane has 3 points nearer than distance={distance:g}; "
                "is it in the right unit?"
            )


def clouds_between(points: Tensor, ptr: Tensor, first: int, stop: int) -> tuple[Tensor, Tensor]:
    """Return the clouds [first, stop) of a batch."""
    if stop - first == ptr.shape[0] - 1:
        return points, ptr
    own = ptr[first : stop + 1]
    return points[int(own[0]) : int(own[-1])], own - own[0]


def face_planes(planes: Tensor, ups: Tensor | None, distance: float) -> Tensor:
    """Turn the normals along ``up``, else toward an origin off the plane, else the largest component is positive."""
    normals, offset = planes[:, :3], planes[:, 3]
    along_up = torch.zeros_like(offset)
    if ups is not None:  # in one order, whatever library multiplies here
        x, y, z = (normals * ups).unbind(1)
        along_up = (x + y) + z
    toward_origin = torch.where(through_origin(planes, distance), 0.0, offset)
    largest = normals.gather(1, normals.abs().argmax(1, keepdim=True)).squeeze(1)
    sign = torch.zeros_like(offset)
    for deciding in (along_up, toward_origin, largest):
        sign = torch.where(sign == 0, deciding.sign(), sign)
    return torch.where((sign < 0)[:, None], -planes, planes)
