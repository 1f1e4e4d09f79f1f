"""The search for planes in one call, planes through what is near or chosen, and where the surface in a plane ends."""

from __future__ import annotations

import math

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
from pcdata.kernels.cpu.native import answers, call, room


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
    planes, near = room((len(counts), 4), torch.float64), room(points.shape[0], torch.bool)
    missed = 0.0 if probability is None else math.log1p(-probability)
    tilt = -1.0 if max_tilt is None else max_tilt
    rules = tilt, float(distance), missed, SCORED_BITS, FLAT, MAX_REFINEMENTS
    for first in range(0, len(counts), at_once):  # the draws of many clouds are many
        some = slice(first, min(first + at_once, len(counts)))
        words, which = words_of_clouds(counts[some], num_hypotheses, seed[some])
        own, own_ptr = clouds_between(points, ptr, some.start, some.stop)
        results = (planes, near) if own is points else (planes[some], near[int(ptr[some.start]) : int(ptr[some.stop])])
        given = [None if value is None else value[some].contiguous() for value in (guess, up)]
        number = some.stop - first
        arrays, found = (own, own_ptr, number, words, num_hypotheses, which), answers(3 * number)
        call("pc_ransac_planes", *arrays, *given, *rules, *results, found)
        told = [*zip(found[::3], found[1::3], found[2::3])]
        require_planes(told, num_hypotheses + (guess is not None), distance, first)
    return planes, near


@kernel("near_planes", "cpu")
def near_planes(points: Tensor, ptr: Tensor, planes: Tensor, distance: float) -> Tensor:
    """Mark in one pass."""
    near = room(points.shape[0], torch.bool)
    call("pc_near_planes", points, ptr, planes.shape[0], planes.float(), float(distance), near)
    return near


@kernel("refine_planes", "cpu")
def refine_planes(
    points: Tensor, ptr: Tensor, planes: Tensor, distance: float, ups: Tensor | None, max_tilt: float | None
) -> tuple[Tensor, Tensor]:
    """Look again at those runs of points alone that the last step of a plane may have changed."""
    refined, near = planes.clone(), room(points.shape[0], torch.bool)
    up, tilt = (None, 0.0) if ups is None or max_tilt is None else (ups.contiguous(), max_tilt)
    rules = float(distance), up, tilt, FLAT, MAX_REFINEMENTS
    call("pc_refine_planes", points, ptr, planes.shape[0], *rules, refined, near)
    return refined, near


@kernel("fit_planes", "cpu")
def fit_planes(points: Tensor, ptr: Tensor, chosen: Tensor) -> Tensor:
    """Sum moments in one pass; the planes are the reference's."""
    # Offsets from a point of the plane are no longer than the plane is wide, so their squares keep their digits.
    origin = points[first_per_cloud(chosen, ptr)].double()
    sums = room((origin.shape[0], 11), torch.float64)
    call("pc_moments", points, ptr, origin.shape[0], chosen, origin, sums)
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
    clouds = planes.shape[0]
    patch, rms = room(points.shape[0], torch.bool), room(clouds, torch.float64)
    corners = room((clouds, MOST_CORNERS), torch.int64)
    given = points.contiguous(), ptr.contiguous(), clouds, near.contiguous(), planes.contiguous(), float(distance)
    call("pc_plane_surfaces", *given, MOST_CORNERS, patch, corners, rms)
    if any(spread < 0 for spread in rms.tolist()):  # the reference says so
        found: tuple[Tensor, Tensor, Tensor] = INNER["plane_surfaces"].reference(points, ptr, near, planes, distance)
        return found
    return patch, corners, rms
