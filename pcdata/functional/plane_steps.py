"""The steps of a search for planes that touch every point, for all clouds at once.

The compiled core counts and searches within its body of ``ransac_plane``; it refines, marks and fits on its own too.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor

from pcdata.contracts.dispatch import REFERENCE, inner
from pcdata.contracts.host import differing
from pcdata.contracts.on_host import bounds_of
from pcdata.functional.rows import count_per_cloud, counts_from_ptr, ptr_from_counts
from pcdata.geometry.plane_fit import fit_plane, plane_distance
from pcdata.geometry.rigid import angle_between
from pcdata.threads import at_once

# The inlier set of real clouds settles in 3 to 8 rounds; the cap only stops a set that alternates for ever.
MAX_REFINEMENTS = 20
# Hypotheses and points looked at together: 1 MB of distances.
_PLANES, _POINTS = 64, 4096
# Hypotheses of the first look where few may do; as many again as there were after each.
_FIRST_TRIES = 64


@inner
def record_planes(
    points: Tensor,
    ptr: Tensor,
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
        counts[:, some] = record_planes(points, ptr, part, asked, distance, floors, backend=REFERENCE)
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
    points: Tensor, ptr: Tensor, planes: Tensor, distance: float, *, backend: str = "auto"
) -> Tensor:  # (N,) bool
    """Mark the points that are near their cloud's plane, planes (B, 4)."""
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


def within_tilt(planes: Tensor, ups: Tensor | None, max_tilt: float | None) -> Tensor:
    """Say which (..., 4) planes may compete."""
    if ups is None or max_tilt is None:
        return torch.ones(planes.shape[:-1], dtype=torch.bool, device="cpu")
    angle = angle_between(planes[..., :3], ups)
    return torch.minimum(angle, math.pi - angle) <= max_tilt
