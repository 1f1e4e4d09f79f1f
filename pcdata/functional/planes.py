"""The dominant plane of a cloud by RANSAC, refined to the least-squares plane of its own inliers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import REFERENCE, inner, op
from pcdata.contracts.host import differing
from pcdata.contracts.numbers import checked_count, checked_fraction, checked_length
from pcdata.contracts.on_host import bounds_of, counts_of
from pcdata.errors import ConfigError, DTypeError, NoPlaneError, ShapeError
from pcdata.functional.rows import count_per_cloud, counts_from_ptr, ptr_from_counts
from pcdata.geometry.plane_fit import fit_plane, plane_distance, planes_through, through_origin
from pcdata.geometry.rigid import angle_between
from pcdata.rng import seeded
from pcdata.threads import at_once

# The inlier set of real clouds settles in 3 to 8 rounds; the cap only stops a set that alternates for ever.
MAX_REFINEMENTS = 20
# Hypotheses and points looked at together: 1 MB of distances.
_PLANES, _POINTS = 64, 4096
# Hypotheses of the first look where few may do; as many again as there were after each.
_FIRST_TRIES = 64
# Points that hypotheses are scored on where they need not be the best of all: their shares are off by 0.4 % or less.
SCORED_BITS, _ALL_BITS = 14, 62
# Planes drawn at a time, over all clouds: 32 MB.
_MOST_HYPOTHESES = 1 << 20


def checked_seeds(where: str, name: str, arguments: Mapping[str, Any]) -> list[int]:
    """Require one seed for every cloud, or one per cloud (B,); bodies get a list of B."""
    seed, num_clouds = arguments[name], len(arguments["ptr"]) - 1
    given = seed.tolist() if isinstance(seed, Tensor) else seed
    seeds = list(given) if isinstance(given, Sequence) else [given] * num_clouds
    if not all(isinstance(one, int) for one in seeds):
        raise DTypeError(f"{where}: seed must be an int, or a sequence or tensor of ints, got {given}")
    if len(seeds) != num_clouds:
        raise ShapeError(f"{where}: {len(seeds)} seeds were given for {num_clouds} clouds")
    return seeds


def checked_up(where: str, name: str, arguments: Mapping[str, Any]) -> Tensor:
    """Require one direction for every cloud, or one per cloud; bodies get (B, 3) float64 unit vectors on the CPU."""
    num_clouds = len(arguments["ptr"]) - 1
    directions = torch.as_tensor(arguments[name], dtype=torch.float64, device="cpu").detach()
    if directions.shape == (3,):
        directions = directions.expand(num_clouds, 3)
    if directions.shape != (num_clouds, 3):
        raise ShapeError(f"{where}: up must be (3,) or ({num_clouds}, 3), got {tuple(directions.shape)}")
    lengths = directions.norm(dim=1)
    if not bool((torch.isfinite(lengths) & (lengths > 0)).all()):
        raise ConfigError(f"{where}: up must be finite and not zero")
    return directions / lengths[:, None]


def checked_tilt(where: str, name: str, arguments: Mapping[str, Any]) -> float:
    """Require an angle from up."""
    tilt: float = arguments[name]
    if arguments["up"] is None:
        raise ConfigError(f"{where}: max_tilt is an angle from up, but up was not given; pass up=(0, 0, 1) or the like")
    if not 0 <= tilt <= math.pi:
        raise ConfigError(f"{where}: max_tilt is in radians, between 0 and pi, got {tilt}")
    return tilt


def checked_probability(where: str, name: str, arguments: Mapping[str, Any]) -> float:
    """Require a number between 0 and 1."""
    value = checked_fraction(where, name, arguments)
    if value == 1:
        raise ConfigError(f"{where}: probability must be less than 1, which no number of tries gives; leave it out")
    return value


def checked_guess(where: str, name: str, arguments: Mapping[str, Any]) -> Tensor:
    """Require one plane per cloud; bodies get (B, 4) float64 on the CPU with unit normals, NaN where there is none."""
    planes = torch.as_tensor(arguments[name], dtype=torch.float64, device="cpu").detach()
    if planes.shape != (len(arguments["ptr"]) - 1, 4):
        raise ShapeError(f"{where}: guess must be ({len(arguments['ptr']) - 1}, 4), got {tuple(planes.shape)}")
    planes = planes / planes[:, :3].norm(dim=1, keepdim=True)
    return planes.masked_fill(~planes.isfinite().all(1, keepdim=True), torch.nan)


# The steps of the search that touch every point, for all clouds at once.


@inner
def draw_planes(
    points: Tensor, ptr: Tensor, triples: Tensor, which: Tensor, *, backend: str = "auto"
) -> Tensor:  # (B, P, 4) float64 on the CPU, as planes_through
    """Return the planes through triples (T, P, 3) of rows within a cloud; ``which`` (B,) of the T each cloud takes."""
    rows = triples[which] + ptr[:-1].cpu()[:, None, None]
    return planes_through(points[rows.to(points.device)].cpu())


@inner
def bound_runs(points: Tensor, ptr: Tensor, *, backend: str = "auto") -> tuple[Tensor, ...]:
    """Return what a backend likes to know of the points before it counts those near planes again and again."""
    return ()


@inner
def record_planes(
    points: Tensor,
    ptr: Tensor,
    runs: tuple[Tensor, ...],  # of bound_runs
    planes: Tensor,  # (B, P, 4)
    competes: Tensor,  # (B, P) bool: the others are not looked at
    distance: float,
    floors: Tensor,  # (B,) int64
    *,
    backend: str = "auto",
) -> Tensor:  # (B, P) int64 on the CPU
    """Count the points near each plane that competes and has more than its cloud's floor and all before it; else 0."""
    counts = torch.zeros(competes.shape, dtype=torch.int64, device="cpu")
    for b, (start, stop) in enumerate(pairwise(bounds_of(ptr))):
        counts[b, competes[b]] = _count_near(points[start:stop], planes[b, competes[b]], distance)
    before = torch.cat([floors[:, None], counts[:, :-1]], 1).cummax(1).values
    return counts.masked_fill_((counts <= before) | (counts <= floors[:, None]), 0)


@inner
def search_planes(
    points: Tensor,
    ptr: Tensor,
    planes: Tensor,  # (B, P, 4)
    competes: Tensor,  # (B, P) bool
    distance: float,
    probability: float,
    not_drawn: int,  # of the first planes
    bits: int,  # 2^bits points are looked at, of clouds that have more
    *,
    backend: str = "auto",
) -> Tensor:  # counts (B, P) of the planes that were the best so far; 0 of others and behind each cloud's last try
    """Score planes as record_planes does, in blocks where few may do, until all clouds have been tried often enough."""
    points, ptr = spread_points(points, ptr, bits)
    floors = torch.zeros(len(ptr) - 1, dtype=torch.int64, device="cpu")
    sizes = counts_from_ptr(ptr).cpu()[:, None].double()
    counts = torch.zeros(competes.shape, dtype=torch.int64, device="cpu")
    tries, first, block = planes.shape[1], 0, _FIRST_TRIES
    last = torch.full_like(sizes, tries)
    while first < tries and bool((last > first).any()):
        some = slice(first, min(first + block, tries))
        part, asked = planes[:, some].contiguous(), competes[:, some] & (last > first)
        counts[:, some] = record_planes(points, ptr, (), part, asked, distance, floors, backend=REFERENCE)
        best = torch.maximum(counts[:, some].cummax(1).values, floors[:, None])
        needed = tries_needed(best, sizes, probability)
        drawn = torch.arange(first + 1, some.stop + 1, dtype=torch.float64, device="cpu") - not_drawn
        done = drawn >= needed
        stop = torch.where(done.any(1, keepdim=True), first + done.int().argmax(1, keepdim=True) + 1.0, last)
        last = torch.where(last > first, stop, last)
        floors = best[:, -1].clone()
        first, block = some.stop, 2 * block
    return counts.masked_fill_(torch.arange(tries, dtype=torch.int64, device="cpu") >= last, 0)


def tries_needed(near: Tensor, sizes: Tensor, probability: float) -> Tensor:
    """Return of how many tries one finds a plane with so many of the points near it, with the probability."""
    # log1p(-1) = -inf: one try finds a plane that holds all
    return math.log1p(-probability) / torch.log1p(-(near / sizes).pow(3))


def spread_points(points: Tensor, ptr: Tensor, bits: int) -> tuple[Tensor, Tensor]:
    """Return 2^bits points of each cloud that has more, and their ptr: one out of each of as many stretches.

    Which one of a stretch follows no period, so rows and columns of images are met alike. Steps of the golden ratio
    fill an interval evenly: Weyl's sequence, as in Knuth, The Art of Computer Programming, volume 3, section 6.4.
    """
    bounds, most = list(pairwise(ptr.tolist())), 1 << bits
    if all(stop - start <= most for start, stop in bounds):
        return points, ptr
    number = torch.arange(most + 1, dtype=torch.int64, device=points.device)
    part = number[:-1] * 2654435769 & 0xFFFFFFFF  # of 2^32
    chosen = []
    for start, stop in bounds:
        if stop - start <= most:
            chosen.append(points[start:stop])
            continue
        edges = start + (number * (stop - start) >> bits)
        chosen.append(points.index_select(0, edges[:-1] + (part * edges.diff() >> 32)))
    return torch.cat(chosen), ptr_from_counts([len(one) for one in chosen], device=ptr.device)


@inner
def near_planes(
    points: Tensor,
    ptr: Tensor,
    planes: Tensor,
    distance: float,
    runs: tuple[Tensor, ...] = (),
    *,
    backend: str = "auto",
) -> Tensor:  # (N,) bool
    """Mark the points that are near their cloud's plane, planes (B, 4); ``runs`` as bound_runs gives them."""
    bounds = pairwise(bounds_of(ptr))
    near = [
        plane_distance(points[start:stop], plane[None])[0].abs_() < distance
        for (start, stop), plane in zip(bounds, planes)
    ]
    return torch.cat(near)


@inner
def fit_planes(points: Tensor, ptr: Tensor, chosen: Tensor, *, backend: str = "auto") -> Tensor:  # (B, 4) on the CPU
    """Fit each cloud's plane to its chosen points (N,) bool; NaN where they lie on a line, as plane_of_moments."""
    none = torch.full((4,), torch.nan, dtype=torch.float64, device="cpu")
    fitted = (fit_plane(points[start:stop][chosen[start:stop]]) for start, stop in pairwise(bounds_of(ptr)))
    return torch.stack([none if plane is None else plane for plane in fitted])


@inner
def refine_planes(
    points: Tensor,
    ptr: Tensor,
    planes: Tensor,  # (B, 4) on the CPU
    distance: float,
    ups: Tensor | None,  # (B, 3) unit vectors on the CPU
    max_tilt: float | None,
    runs: tuple[Tensor, ...] = (),  # of bound_runs, if they are known
    *,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # planes (B, 4) on the CPU, inliers (N,)
    """Refit to the inliers until they no longer change; return the last allowed planes and their inliers."""
    planes = planes.clone()
    inliers = near_planes(points, ptr, planes, distance, backend=REFERENCE)
    unsettled = torch.arange(len(planes), dtype=torch.int64, device="cpu")  # clouds
    rows, own, own_ptr, before = None, points, ptr, inliers
    for _ in range(MAX_REFINEMENTS):
        refitted = fit_planes(own, own_ptr, before, backend=REFERENCE)
        fits = ~refitted[:, 0].isnan() & within_tilt(refitted, None if ups is None else ups[unsettled], max_tilt)
        after = near_planes(own, own_ptr, refitted, distance, backend=REFERENCE)
        fits &= count_per_cloud(after, own_ptr).cpu() >= 3
        settled = fits & (count_per_cloud(differing(after, before), own_ptr).cpu() == 0)
        planes[unsettled[fits]] = refitted[fits]
        chosen = after
        if not bool(fits.all()):
            taken = fits.to(own_ptr.device).repeat_interleave(counts_from_ptr(own_ptr))
            chosen = torch.where(taken, after, before)
        if rows is None:
            inliers = chosen
        else:
            inliers[rows] = chosen
        open_ = fits & ~settled
        if not bool(open_.any()):
            break
        if not bool(open_.all()):
            kept = open_.to(own_ptr.device).repeat_interleave(counts_from_ptr(own_ptr))
            rows = kept.nonzero().squeeze(1) if rows is None else rows[kept]
            own, own_ptr = own[kept], ptr_from_counts(counts_from_ptr(own_ptr)[open_.to(own_ptr.device)])
            chosen, unsettled = chosen[kept], unsettled[open_]
        before = chosen
    return planes, inliers


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
    steps=(draw_planes, bound_runs, record_planes, search_planes, refine_planes),
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
    at_once = max(1, _MOST_HYPOTHESES // num_hypotheses)
    winners = []
    runs: tuple[Tensor, ...] = ()
    for first in range(0, num_clouds, at_once):
        some = slice(first, min(first + at_once, num_clouds))
        own, own_ptr = _clouds_between(points, ptr, some.start, some.stop)
        triples, which = _draw_triples(counts[some], num_hypotheses, seed[some])
        hypotheses = draw_planes(own, own_ptr, triples, which, backend=backend)
        if guess is not None:
            hypotheses = torch.cat([guess[some, None], hypotheses], 1)
        is_plane = ~hypotheses[..., 0].isnan()
        competes = is_plane & within_tilt(hypotheses, None if up is None else up[some, None], max_tilt)
        runs = bound_runs(own, own_ptr, backend=backend)
        if probability is None:
            floors = torch.zeros(len(own_ptr) - 1, dtype=torch.int64, device="cpu")
            near = record_planes(own, own_ptr, runs, hypotheses, competes, distance, floors, backend=backend)
        else:
            search = distance, probability, hypotheses.shape[1] - num_hypotheses
            near = search_planes(own, own_ptr, hypotheses, competes, *search, SCORED_BITS, backend=backend)
            for b in (near.amax(1) < 3).nonzero().squeeze(1).tolist():
                alone = *_clouds_between(own, own_ptr, b, b + 1), hypotheses[b : b + 1], competes[b : b + 1]
                near[b] = search_planes(*alone, *search, _ALL_BITS, backend=backend)[0]
        winners.append(_best_planes(hypotheses, is_plane, competes, near, distance, first))
    runs = runs if at_once >= num_clouds else ()  # of all clouds
    planes, inliers = refine_planes(points, ptr, torch.cat(winners), distance, up, max_tilt, runs, backend=backend)
    return face_planes(planes, up, distance).to(points.device), inliers


def _draw_triples(counts: list[int], num_hypotheses: int, seeds: list[int]) -> tuple[Tensor, Tensor]:
    """Draw the triples of every cloud, (T, P, 3) int64, and say which each takes, (B,): equal clouds share a draw."""
    number: dict[tuple[int, int], int] = {}
    which = [number.setdefault(draw, len(number)) for draw in zip(counts, seeds)]
    drawn = [draw_rows(count, 3, num_hypotheses, seeded(seed)) for count, seed in number]
    return torch.stack(drawn), torch.tensor(which, dtype=torch.int64, device="cpu")


def draw_rows(num_points: int, size: int, count: int, generator: torch.Generator) -> Tensor:
    """Draw (count, size) rows of a cloud, distinct within each draw and uniform: each skips over those before it."""
    drawn: list[Tensor] = []
    rising: list[Tensor] = []  # the same in order
    for taken in range(size):
        row = torch.randint(num_points - taken, (count,), generator=generator, device="cpu")
        for before in rising:
            row += row >= before
        drawn.append(row)
        for place, other in enumerate(rising):
            rising[place], row = torch.minimum(other, row), torch.maximum(other, row)
        rising.append(row)
    return torch.stack(drawn, dim=1)


def _best_planes(
    planes: Tensor, is_plane: Tensor, competes: Tensor, counts: Tensor, distance: float, first_cloud: int
) -> Tensor:
    """Return each cloud's plane with the most inliers, the earliest among equals, (B, 4)."""
    for cloud in (~competes.any(1)).nonzero().squeeze(1).tolist():
        reason = (
            f"none of the {int(is_plane[cloud].sum())} planes found is within max_tilt of up; is up in the frame of "
            "the cloud?"
            if bool(is_plane[cloud].any())
            else f"all {planes.shape[1]} triples drawn lie on a line"
        )
        raise NoPlaneError(f"ransac_plane: cloud {first_cloud + cloud}: {reason}")
    best = counts.argmax(1)  # the first of equals, as torch documents
    for cloud in (counts.gather(1, best[:, None]) < 3).squeeze(1).nonzero().squeeze(1).tolist():
        raise NoPlaneError(
            f"ransac_plane: cloud {first_cloud + cloud}: no plane has 3 points nearer than distance={distance:g}; "
            "is it in the right unit?"
        )
    return planes[torch.arange(len(planes), dtype=torch.int64, device="cpu"), best]


def _count_near(points: Tensor, planes: Tensor, distance: float) -> Tensor:
    """Count the points nearer than ``distance`` to each plane, in blocks: memory does not grow with the product."""
    counts = torch.zeros(len(planes), dtype=torch.float64, device=points.device)
    planes_per_block, points_per_block = _PLANES, at_once(points.device, _POINTS)
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


def _clouds_between(points: Tensor, ptr: Tensor, first: int, stop: int) -> tuple[Tensor, Tensor]:
    """Return the clouds [first, stop) of a batch."""
    own = ptr[first : stop + 1]
    if stop - first == len(ptr) - 1:
        return points, ptr
    return points[int(own[0]) : int(own[-1])], own - own[0]


def face_planes(planes: Tensor, ups: Tensor | None, distance: float) -> Tensor:
    """Turn the normals along ``up``, else toward an origin off the plane, else the largest component is positive."""
    normals, offset = planes[:, :3], planes[:, 3]
    along_up = torch.zeros_like(offset) if ups is None else torch.linalg.vecdot(normals, ups)
    toward_origin = torch.where(through_origin(planes, distance), 0.0, offset)
    largest = normals.gather(1, normals.abs().argmax(1, keepdim=True)).squeeze(1)
    sign = torch.zeros_like(offset)
    for deciding in (along_up, toward_origin, largest):
        sign = torch.where(sign == 0, deciding.sign(), sign)
    return torch.where((sign < 0)[:, None], -planes, planes)


def within_tilt(planes: Tensor, ups: Tensor | None, max_tilt: float | None) -> Tensor:
    """Say which (..., 4) planes may compete."""
    if ups is None or max_tilt is None:
        return torch.ones(planes.shape[:-1], dtype=torch.bool, device="cpu")
    angle = angle_between(planes[..., :3], ups)
    return torch.minimum(angle, math.pi - angle) <= max_tilt
