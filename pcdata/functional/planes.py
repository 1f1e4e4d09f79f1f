"""The dominant plane of a cloud by RANSAC, refined to the least-squares plane of its own inliers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from pcdata.checks import count_true, equal_values
from pcdata.dispatch import op
from pcdata.errors import ConfigError, DTypeError, NoPlaneError, ShapeError, TooFewPointsError
from pcdata.functional.parameters import require_count, require_length
from pcdata.functional.rigid import angle_between
from pcdata.rng import seeded

# The inlier set of real clouds settles in 3 to 8 rounds; the cap only stops a set that alternates for ever.
_MAX_REFINEMENTS = 20
# Hypotheses x points scored at once: 1 MB of distances stays in a CPU core's cache; a GPU wants fewer launches.
_BLOCK = {"cpu": (64, 4096), "cuda": (64, 262144)}
# A triangle this flat, in float32 steps of its largest coordinate, cannot be told from a line.
_FLAT_STEPS = 8.0


@op(points="N 3", ptr="ptr N B")
@torch.no_grad()
def ransac_plane(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,)
    *,
    distance: float = 0.01,
    num_hypotheses: int = 1000,
    seed: int | Sequence[int] | Tensor = 0,
    up: Tensor | Sequence[float] | None = None,
    max_tilt: float | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # planes (B, 4) float64, inlier_mask (N,) bool
    """Find each cloud's plane with the most points nearer than ``distance`` (strictly, as Open3D).

    A plane is (nx, ny, nz, d) with a unit normal and n.p + d = 0. Every hypothesis is scored on all points (no early
    stop); ties go to the earliest. The winner is then refitted to its inliers by least squares until the inliers no
    longer change (at most 20 rounds).

    ``inlier_mask`` is ``|((nx*x + ny*y) + nz*z) + d| < distance`` in float32, with the plane rounded to float32.
    The normal points along ``up`` when given, else towards the origin, where the sensor is (d >= 0). A plane nearer to
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
        backend: which body to run; see :mod:`pcdata.dispatch`.

    Raises:
        TooFewPointsError: a cloud has fewer than 3 points.
        NoPlaneError: no hypothesis is a plane (all points on a line) within the tilt limit.
        ConfigError: a parameter out of range, or ``max_tilt`` without ``up``.

    Source: Fischler & Bolles, CACM 24(6), 1981.
    """
    assert ptr is not None
    return search_planes(points, ptr, _TORCH_WORK, distance, num_hypotheses, seed, up, max_tilt)


@dataclass(frozen=True)
class PlaneWork:
    """The parts of :func:`ransac_plane` that touch every point; a kernel brings its own."""

    count_inliers: Callable[[Tensor, Tensor, float], Tensor]  # points (N, 3), planes (P, 4), distance -> (P,) int64
    inlier_mask: Callable[[Tensor, Tensor, float], Tensor]  # points (N, 3), plane (4,), distance -> (N,) bool
    fit: Callable[[Tensor, Tensor], Tensor | None]  # points (N, 3), chosen (N,) bool -> plane (4,), as fit_plane


def search_planes(
    points: Tensor,
    ptr: Tensor,
    work: PlaneWork,
    distance: float,
    num_hypotheses: int,
    seed: int | Sequence[int] | Tensor,
    up: Tensor | Sequence[float] | None,
    max_tilt: float | None,
) -> tuple[Tensor, Tensor]:  # planes (B, 4) float64, inlier_mask (N,) bool
    """Run :func:`ransac_plane` with the given work: draws, decisions and refinement are the same for all kernels."""
    num_clouds = len(ptr) - 1
    _check_parameters(distance, num_hypotheses, max_tilt, up)
    seeds = _seed_per_cloud(seed, num_clouds)
    ups = _up_per_cloud(up, num_clouds)
    planes = torch.zeros((num_clouds, 4), dtype=torch.float64, device="cpu")
    inlier_masks = []
    bounds = ptr.tolist()
    for cloud, (start, stop) in enumerate(pairwise(bounds)):
        if stop - start < 3:
            raise TooFewPointsError(f"ransac_plane: a plane needs 3 points, cloud {cloud} has {stop - start}")
        allowed = _tilt_test(ups[cloud], max_tilt)
        own = points[start:stop]
        hypotheses = _draw_planes(own, num_hypotheses, seeds[cloud])
        where = f"ransac_plane: cloud {cloud}"
        winner = _best_plane(own, hypotheses, allowed(hypotheses), distance, where, work)
        plane, inlier_mask = _refine(own, winner, distance, allowed, work)
        planes[cloud] = _face(plane, ups[cloud], distance)
        inlier_masks.append(inlier_mask)
    return planes.to(points.device), inlier_masks[0] if num_clouds == 1 else torch.cat(inlier_masks)


def plane_distance(
    points: Tensor,  # (N, 3) float32
    planes: Tensor,  # (P, 4)
    *,
    out: tuple[Tensor, Tensor] | None = None,  # two (P, N) float32 buffers; the first becomes the result
) -> Tensor:  # (P, N) float32
    """Return signed distances as ((nx*x + ny*y) + nz*z) + d.

    Separate float32 operations: nothing fuses them, so every backend and device gets the same bits.
    """
    x, y, z = points.unbind(-1)
    nx, ny, nz, d = planes.to(dtype=torch.float32, device=points.device)[..., None].unbind(1)
    total, product = out or (points.new_empty((len(planes), len(points))), None)
    torch.mul(nx, x, out=total)
    total += torch.mul(ny, y, out=product)
    total += torch.mul(nz, z, out=product)
    total += d
    return total


def fit_plane(points: Tensor) -> Tensor | None:
    """Return the (4,) float64 least-squares plane of (N, 3) points on the CPU, or None if they lie on a line.

    The normal is the eigenvector of the smallest eigenvalue of the covariance; its sign is arbitrary.
    """
    if len(points) < 3:
        return None
    wide = points.double()
    centre = wide.mean(dim=0)
    centred = wide - centre
    return plane_of_moments(centre.cpu(), ((centred.T @ centred) / len(points)).cpu(), wide.abs().max().cpu())


def plane_of_moments(
    centre: Tensor,  # (3,) float64
    covariance: Tensor,  # (3, 3) float64
    largest: Tensor,  # () absolute coordinate
) -> Tensor | None:  # (4,) float64
    """Return the plane of :func:`fit_plane` from the moments of the points, all on the CPU."""
    variance, directions = torch.linalg.eigh(covariance)
    if float(variance[1].clamp(min=0).sqrt()) <= _flat_height(largest):
        return None
    normal = directions[:, 0]
    return torch.cat([normal, -(normal @ centre)[None]])


def _draw_planes(points: Tensor, count: int, seed: int) -> Tensor:
    """Return (count, 4) float64 planes on the CPU through random triples; rows of a collinear triple are NaN."""
    triples = _draw_triples(len(points), count, seed)
    corners = points[triples.to(points.device)].cpu().double()
    a, b, c = corners.unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    length = normal.norm(dim=-1)
    longest = torch.stack([(b - a).norm(dim=-1), (c - a).norm(dim=-1), (c - b).norm(dim=-1)]).amax(0)
    collinear = ~(length > longest * _flat_height(corners.abs().amax(dim=(1, 2))))
    normal = normal / length[:, None]
    planes = torch.cat([normal, -(normal * a).sum(-1, keepdim=True)], dim=1)
    return planes.masked_fill(collinear[:, None], torch.nan)


def _draw_triples(num_points: int, count: int, seed: int) -> Tensor:
    """Draw (count, 3) indices, distinct within a row and uniform: each skips over those before it."""
    generator = seeded(seed)
    first, second, third = (
        torch.randint(num_points - taken, (count,), generator=generator, device="cpu") for taken in range(3)
    )
    second += second >= first
    third += third >= torch.minimum(first, second)
    third += third >= torch.maximum(first, second)
    return torch.stack([first, second, third], dim=1)


def _best_plane(
    points: Tensor, planes: Tensor, allowed: Tensor, distance: float, where: str, work: PlaneWork
) -> Tensor:
    """Return the allowed plane with the most inliers, the earliest among equals."""
    is_plane = ~planes[:, 0].isnan()
    competes = is_plane & allowed
    if not bool(competes.any()):
        reason = (
            f"none of the {int(is_plane.sum())} planes found is within max_tilt of up; is up in the frame of the cloud?"
            if bool(is_plane.any())
            else f"all {len(planes)} triples drawn lie on a line"
        )
        raise NoPlaneError(f"{where}: {reason}")
    candidates = planes[competes]
    counts = work.count_inliers(points, candidates, distance)
    best = int(counts.argmax())  # the first of equals, as torch documents
    if int(counts[best]) < 3:
        raise NoPlaneError(
            f"{where}: no plane has 3 points nearer than distance={distance:g}; is it in the right unit?"
        )
    return candidates[best]


def _count_inliers(points: Tensor, planes: Tensor, distance: float) -> Tensor:
    """Count the points nearer than ``distance`` to each plane, in blocks: memory does not grow with the product."""
    counts = torch.zeros(len(planes), dtype=torch.float64, device=points.device)
    planes_per_block, points_per_block = _BLOCK.get(points.device.type, _BLOCK["cuda"])
    # One contiguous column per coordinate: a strided inner loop is several times slower.
    columns = points.T.contiguous()
    buffers = points.new_empty((2, planes_per_block * points_per_block))
    for first in range(0, len(planes), planes_per_block):
        some = planes[first : first + planes_per_block].to(points.device)
        for begin in range(0, len(points), points_per_block):
            block = columns[:, begin : begin + points_per_block].T
            total, product = buffers[:, : len(some) * len(block)].reshape(2, len(some), len(block)).unbind(0)
            near = plane_distance(block, some, out=(total, product)).abs_()
            # Ones and zeros as floats: five times faster than bool, and exact below 2^24 points per block.
            counts[first : first + planes_per_block] += near.lt_(distance).sum(dim=1)
    return counts.long().cpu()


def _refine(
    points: Tensor, plane: Tensor, distance: float, allowed: Callable[[Tensor], Tensor], work: PlaneWork
) -> tuple[Tensor, Tensor]:
    """Refit to the inliers until they no longer change; return the last allowed plane and its inliers."""
    inliers = work.inlier_mask(points, plane, distance)
    for _ in range(_MAX_REFINEMENTS):
        refitted = work.fit(points, inliers)
        if refitted is None or not bool(allowed(refitted)):
            break
        refitted_inliers = work.inlier_mask(points, refitted, distance)
        if count_true(refitted_inliers) < 3:
            break
        settled = equal_values(refitted_inliers, inliers)
        plane, inliers = refitted, refitted_inliers
        if settled:
            break
    return plane, inliers


def _inlier_mask(points: Tensor, plane: Tensor, distance: float) -> Tensor:
    return plane_distance(points, plane[None])[0].abs_() < distance


def _face(plane: Tensor, up: Tensor | None, distance: float) -> Tensor:
    """Turn the normal along ``up``, else towards an origin off the plane, else its largest component is positive."""
    along_up = 0.0 if up is None else float(plane[:3] @ up)
    towards_origin = 0.0 if through_origin(plane, distance) else float(plane[3])
    deciding = [along_up, towards_origin, float(plane[:3][plane[:3].abs().argmax()])]
    return -plane if next(value for value in deciding if value != 0.0) < 0 else plane


def through_origin(plane: Tensor, distance: float) -> bool:
    """Whether the origin is an inlier of a plane (4,): then no side of it can be told by where the origin lies."""
    return abs(float(plane[3])) < distance


def _tilt_test(up: Tensor | None, max_tilt: float | None) -> Callable[[Tensor], Tensor]:
    """Return the test that (..., 4) planes must pass to compete."""
    if up is None or max_tilt is None:
        return lambda planes: torch.ones(planes.shape[:-1], dtype=torch.bool, device="cpu")

    def within_tilt(planes: Tensor) -> Tensor:
        angle = angle_between(planes[..., :3], up)
        return torch.minimum(angle, math.pi - angle) <= max_tilt

    return within_tilt


def _flat_height(largest: Tensor) -> Tensor:
    return _FLAT_STEPS * torch.finfo(torch.float32).eps * largest


def _check_parameters(
    distance: float, num_hypotheses: int, max_tilt: float | None, up: Tensor | Sequence[float] | None
) -> None:
    require_length("ransac_plane", "distance", distance)
    require_count("ransac_plane", "num_hypotheses", num_hypotheses)
    if max_tilt is not None and up is None:
        raise ConfigError(
            "ransac_plane: max_tilt is an angle from up, but up was not given; pass up=(0, 0, 1) or the like"
        )
    if max_tilt is not None and not 0 <= max_tilt <= math.pi:
        raise ConfigError(f"ransac_plane: max_tilt is in radians, between 0 and pi, got {max_tilt}")


def _seed_per_cloud(seed: int | Sequence[int] | Tensor, num_clouds: int) -> list[int]:
    given = seed.tolist() if isinstance(seed, Tensor) else seed
    seeds = list(given) if isinstance(given, Sequence) else [given] * num_clouds
    if not all(isinstance(one, int) for one in seeds):
        raise DTypeError(f"ransac_plane: seed must be an int, or a sequence or tensor of ints, got {given}")
    if len(seeds) != num_clouds:
        raise ShapeError(f"ransac_plane: {len(seeds)} seeds were given for {num_clouds} clouds")
    return seeds


def _up_per_cloud(up: Tensor | Sequence[float] | None, num_clouds: int) -> list[Tensor | None]:
    if up is None:
        return [None] * num_clouds
    directions = torch.as_tensor(up, dtype=torch.float64, device="cpu")
    if directions.shape == (3,):
        directions = directions.expand(num_clouds, 3)
    if directions.shape != (num_clouds, 3):
        raise ShapeError(f"ransac_plane: up must be (3,) or ({num_clouds}, 3), got {tuple(directions.shape)}")
    lengths = directions.norm(dim=1)
    if not bool((torch.isfinite(lengths) & (lengths > 0)).all()):
        raise ConfigError("ransac_plane: up must be finite and not zero")
    return list((directions / lengths[:, None]).unbind(0))


_TORCH_WORK = PlaneWork(_count_inliers, _inlier_mask, lambda points, inliers: fit_plane(points[inliers]))
