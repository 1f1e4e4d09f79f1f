"""Sampling kernels: planes, voxels, farthest points."""

from __future__ import annotations

import math
from itertools import accumulate, pairwise
from typing import Any

import torch
from torch import Tensor

import pcdata.functional.planes
import pcdata.functional.sampling  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, OPERATIONS, kernel
from pcdata.contracts.on_host import counts_of
from pcdata.functional.planes import MAX_REFINEMENTS
from pcdata.functional.rows import first_per_cloud, ptr_from_counts
from pcdata.functional.voxels import SIZE_TOLERANCE
from pcdata.geometry.plane_fit import FLAT, plane_of_moments
from pcdata.kernels.cpu.native import call, numbers, room

# What pc_bound_runs looks at: points of a run, and runs that fit a register; smaller clouds it leaves alone.
_RUN, _RUNS_AT_ONCE, _SMALL_CLOUD = 64, 16, 8192
# The core numbers the rows of one cloud, and voxels, with 32 bits.
_MAX_ROWS = 2**31 - 1


@kernel("farthest_rows", "cpu")
def farthest_rows(points: Tensor, ptr: Tensor, counts: list[int]) -> Tensor:
    """Visit only the points that a pick can change."""
    width = points.shape[1]
    if not width or _too_long(ptr):
        rows: Tensor = INNER["farthest_rows"].reference(points, ptr, counts)
        return rows
    picks, wanted = room(sum(counts), torch.int64), numbers(counts)
    arrays = points.contiguous(), ptr.contiguous(), len(counts)
    if width == 3:
        call("pc_farthest_points", *arrays, wanted, picks)
    else:
        call("pc_wide_farthest_points", *arrays, width, wanted, picks)
    return picks if len(counts) == 1 else picks.add_(torch.repeat_interleave(ptr[:-1], wanted))


@kernel("voxel_means", "cpu")
def voxel_means(
    points: Tensor, ptr: Tensor, edges: Tensor, origin: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Number voxels in a hash table; sums are integers, so threads change nothing."""
    if _too_long(ptr):
        return _reference("voxel_means", points, ptr, edges, origin)
    # As many rows as there could be: those not written never become memory.
    points, ptr = points.contiguous(), ptr.contiguous()
    means, inverse, members = room(points.shape, points.dtype), *(room(len(points), torch.int64) for _ in range(2))
    counts, spans_too_many = room(len(ptr) - 1, torch.int64), room(1, torch.int64)
    sizes = edges.expand(-1, 3).contiguous()
    corners = None if origin is None else origin.contiguous()
    arrays = points, ptr, len(ptr) - 1, sizes, corners, means, inverse, members, counts, spans_too_many
    call("pc_voxel_downsample", *arrays)
    if spans_too_many:
        return _reference("voxel_means", points, ptr, edges, origin)  # knows what to say
    means_ptr = ptr_from_counts(counts)
    number = int(means_ptr[-1])
    # Not clone(): see pcdata.contracts.tensors on torch's threads.
    means, members = (torch.from_numpy(values[:number].numpy().copy()) for values in (means, members))
    return means, means_ptr, inverse, members


@kernel("find_voxel_size", "cpu")
def find_voxel_size(points: Tensor, ptr: Tensor, *, num_points: int) -> Tensor:
    """Bisect like the reference: small clouds side by side, large ones with all threads."""
    sizes, possible = room(len(ptr) - 1, torch.float64), room(1, torch.int64)
    if not _too_long(ptr) and num_points <= _MAX_ROWS:
        call("pc_find_voxel_sizes", points, ptr, len(sizes), num_points, SIZE_TOLERANCE, sizes, possible)
        if possible:
            return sizes
    return _reference("find_voxel_size", points, ptr, num_points=num_points)  # knows what to say


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


def _too_long(ptr: Tensor) -> bool:
    return max(counts_of(ptr)) > _MAX_ROWS


def _reference(name: str, *args: Any, **kwargs: Any) -> Any:
    return (OPERATIONS if name in OPERATIONS else INNER)[name].reference(*args, **kwargs)
