"""The search for planes, all of it in one call, and its steps; and where the surface in a plane ends."""

from __future__ import annotations

import math
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from pcdata.contracts.dispatch import INNER, kernel
from pcdata.contracts.on_host import counts_of
from pcdata.functional.plane_steps import MAX_REFINEMENTS
from pcdata.functional.plane_surfaces import MOST_CORNERS
from pcdata.functional.planes import MOST_HYPOTHESES, SCORED_BITS, clouds_between, require_planes
from pcdata.functional.row_draws import words_of_clouds
from pcdata.functional.rows import first_per_cloud
from pcdata.geometry.plane_fit import FLAT, plane_of_moments
from pcdata.kernels.cpu.native import call, room

# What pc_bound_runs looks at: points of a run, and runs that fit a register; smaller clouds it leaves alone.
_RUN, _RUNS_AT_ONCE, _SMALL_CLOUD = 64, 16, 8192


@kernel("ransac_plane", "cpu")
def ransac_plane(
    *,
    points: Tensor,
    ptr: Tensor,
    distance: float,
    num_hypotheses: int,
    seed: list[int],
    up: Tensor | None,
    max_tilt: float | None,
    probability: float | None,
    guess: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Draw, count, choose, refine and turn in one call; planes are made when it is their turn."""
    counts, at_once = counts_of(ptr), max(1, MOST_HYPOTHESES // num_hypotheses)
    planes, near = room((len(counts), 4), torch.float64), room(len(points), torch.bool)
    found = room((len(counts), 3), torch.int64)
    missed = 0.0 if probability is None else math.log1p(-probability)
    tilt = -1.0 if max_tilt is None else max_tilt
    rules = tilt, float(distance), missed, SCORED_BITS, FLAT, MAX_REFINEMENTS
    for first in range(0, len(counts), at_once):  # the draws of many clouds are many
        some = slice(first, min(first + at_once, len(counts)))
        words, which = words_of_clouds(counts[some], num_hypotheses, seed[some])
        own, own_ptr = clouds_between(points, ptr, some.start, some.stop)
        rows = slice(0, len(points)) if own is points else slice(int(ptr[some.start]), int(ptr[some.stop]))
        given = (None if value is None else value[some].contiguous() for value in (guess, up))
        arrays, told = (own, own_ptr, len(which), words, num_hypotheses, which), found[some]
        call("pc_ransac_planes", *arrays, *given, *rules, planes[some], near[rows], told)
        require_planes(told, num_hypotheses + (guess is not None), distance, first)
    return planes, near


@kernel("draw_planes", "cpu")
def draw_planes(points: Tensor, ptr: Tensor, triples: Tensor, which: Tensor) -> Tensor:
    """Make the planes of all clouds in one pass."""
    planes = room((len(which), triples.shape[1], 4), torch.float64)
    call("pc_planes_of_triples", points, ptr, len(which), triples, triples.shape[1], which, FLAT, planes)
    return planes


@kernel("bound_runs", "cpu")
def bound_runs(points: Tensor, ptr: Tensor) -> tuple[Tensor, ...]:
    """Look at 64 points that follow each other at a time, where that is worth it: in large clouds."""
    counts = [stop - start for start, stop in pairwise(ptr.tolist())]
    if max(counts, default=0) <= _SMALL_CLOUD:
        return ()
    points_at_once = _RUN * _RUNS_AT_ONCE
    runs = [-(-count // points_at_once) * _RUNS_AT_ONCE if count > _SMALL_CLOUD else 0 for count in counts]
    run_ptr = torch.tensor([0, *accumulate(runs)], dtype=torch.int64, device="cpu")
    facts = room((8, sum(runs)), torch.float32)
    call("pc_bound_runs", points, ptr, len(counts), run_ptr, facts)
    return run_ptr, facts


@kernel("record_planes", "cpu")
def record_planes(
    points: Tensor,
    ptr: Tensor,
    runs: tuple[Tensor, ...],
    planes: Tensor,
    competes: Tensor,
    distance: float,
    floors: Tensor,
) -> Tensor:
    """Look at runs of points first: they tell of most planes that they are no records, and of most points."""
    counts = room(planes.shape[:2], torch.int64)
    count, some, known = len(planes), planes.shape[1], runs or (None, None)
    call(
        "pc_record_planes", points, ptr, count, *known, planes.float(), competes, some, float(distance), floors, counts
    )  # fmt: skip
    return counts


@kernel("search_planes", "cpu")
def search_planes(
    points: Tensor,
    ptr: Tensor,
    planes: Tensor,
    competes: Tensor,
    distance: float,
    probability: float,
    not_drawn: int,
    bits: int,
) -> Tensor:
    """Count some planes at a time on points that stay in the processor's cache."""
    counts, missed = room(planes.shape[:2], torch.int64), math.log1p(-probability)
    some = planes.float(), competes.contiguous(), planes.shape[1], float(distance), missed, not_drawn, counts
    call("pc_search_planes", points, ptr, len(planes), bits, *some)
    return counts


@kernel("near_planes", "cpu")
def near_planes(points: Tensor, ptr: Tensor, planes: Tensor, distance: float, runs: tuple[Tensor, ...] = ()) -> Tensor:
    """Mark in one pass, runs of points at once where they are known."""
    near = room(len(points), torch.bool)
    known = runs or (None, None)
    call("pc_near_planes", points, ptr, len(planes), *known, planes.float(), float(distance), near)
    return near


@kernel("refine_planes", "cpu")
def refine_planes(
    points: Tensor,
    ptr: Tensor,
    planes: Tensor,
    distance: float,
    ups: Tensor | None,
    max_tilt: float | None,
    runs: tuple[Tensor, ...] = (),
) -> tuple[Tensor, Tensor]:
    """Look again at those runs of points alone that the last step of a plane may have changed."""
    refined, near = planes.clone(), room(len(points), torch.bool)
    known = runs or (None, None)
    up, tilt = (None, 0.0) if ups is None or max_tilt is None else (ups.contiguous(), max_tilt)
    arrays = points, ptr, len(planes), *known, float(distance), up, tilt, FLAT, MAX_REFINEMENTS, refined, near
    call("pc_refine_planes", *arrays)
    return refined, near


@kernel("fit_planes", "cpu")
def fit_planes(points: Tensor, ptr: Tensor, chosen: Tensor) -> Tensor:
    """Sum moments in one pass; the planes are the reference's."""
    # Offsets from a point of the plane are no longer than the plane is wide, so their squares keep their digits.
    origin = points[first_per_cloud(chosen, ptr)].double()
    sums = room((len(origin), 11), torch.float64)
    call("pc_moments", points, ptr, len(origin), chosen, origin, sums)
    count = sums[:, :1].clamp(min=1)
    mean = sums[:, 2:5] / count
    xx, xy, xz, yy, yz, zz = (sums[:, 5:] / count).unbind(1)
    second = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=1).reshape(-1, 3, 3)
    planes = plane_of_moments(origin + mean, second - mean[:, :, None] * mean[:, None, :], sums[:, 1])
    return planes.masked_fill(sums[:, :1] < 3, torch.nan)


@kernel("plane_surfaces", "cpu")
def plane_surfaces(
    points: Tensor, ptr: Tensor, near: Tensor, planes: Tensor, distance: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Find cells, mark points, and find corners among few of these, in one call."""
    patch, rms = room(len(points), torch.bool), room(len(planes), torch.float64)
    corners = room((len(planes), MOST_CORNERS), torch.int64)
    given = points.contiguous(), ptr.contiguous(), len(planes), near.contiguous(), planes.contiguous(), float(distance)
    call("pc_plane_surfaces", *given, MOST_CORNERS, patch, corners, rms)
    if any(spread < 0 for spread in rms.tolist()):  # the reference says so
        found: tuple[Tensor, Tensor, Tensor] = INNER["plane_surfaces"].reference(points, ptr, near, planes, distance)
        return found
    return patch, corners, rms
