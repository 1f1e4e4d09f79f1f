"""Several planes of a cloud, and the one among them that things stand on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count, checked_fraction, checked_length, checked_places
from pcdata.errors import NoPlaneError, UnitError
from pcdata.functional.clusters import dbscan, density_clusters
from pcdata.functional.neighbors import nearest_rows
from pcdata.functional.planes import (
    bound_runs,
    checked_probability,
    checked_seeds,
    checked_tilt,
    checked_up,
    draw_planes,
    fit_planes,
    near_planes,
    ransac_plane,
    record_planes,
    refined_planes,
)
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.selection import over_hull
from pcdata.functional.voxels import voxel_downsample

# Points that tell which planes there are, and refine the one that is chosen.
_SAMPLE = 1 << 16
# Lengths of a cloud, in distances: beyond, float32 does not hold the distances themselves.
_MOST_SPAN = 1e6
# A plane that leans away from up by 90 degrees or more counts a tenth of a level one.
_LEAST_LEAN = 0.1


@op(
    points="N 3",
    ptr="ptr N B",
    distance=checked_length,
    num_hypotheses=checked_count,
    seed=checked_seeds,
    up=checked_up,
    max_tilt=checked_tilt,
    probability=checked_probability,
    max_planes=checked_count,
    min_share=checked_fraction,
    steps=(draw_planes, bound_runs, record_planes, near_planes, fit_planes),
    gradient=False,
)
def segment_planes(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    distance: float = 0.01,
    num_hypotheses: int = 1000,
    seed: int | Sequence[int] | Tensor = 0,
    up: Tensor | Sequence[float] | None = None,
    max_tilt: float | None = None,
    probability: float | None = None,
    max_planes: int = 8,
    min_share: float = 0.03,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # planes (P, 4) float64, their ptr (B+1,), label (N,) int64
    """Find the planes of each cloud one after another: :func:`ransac_plane` on the points that no plane has yet.

    ``label`` is the number of each point's plane within its cloud, in the order found, and -1 for points of none. A
    cloud may have no plane.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        distance: points nearer than this to a plane become its own, as in :func:`ransac_plane`.
        num_hypotheses: as there, for every plane.
        seed: as there.
        up: as there.
        max_tilt: as there.
        probability: as there.
        max_planes: planes of a cloud at most.
        min_share: of the points of its cloud that a plane must hold; the search ends where the next one does not.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ConfigError: a parameter out of range, or ``max_tilt`` without ``up``.
    """
    assert ptr is not None  # @op fills it
    assert isinstance(seed, list)  # and makes it one per cloud
    assert up is None or isinstance(up, Tensor)
    label = torch.full((len(points),), -1, dtype=torch.int64, device=points.device)
    planes: list[Tensor] = []
    counts = []
    for b, (start, stop) in enumerate(pairwise(ptr.tolist())):
        rest = torch.arange(start, stop, dtype=torch.int64, device=points.device)
        least, found = max(3, math.ceil(min_share * (stop - start))), 0
        while found < max_planes and len(rest) >= least:
            try:
                plane, near = ransac_plane(
                    points[rest],
                    distance=distance,
                    num_hypotheses=num_hypotheses,
                    seed=seed[b],
                    up=None if up is None else up[b],
                    max_tilt=max_tilt,
                    probability=probability,
                    backend=backend,
                )
            except NoPlaneError:
                break
            if int(near.sum()) < least:
                break
            label[rest[near]] = found
            planes.append(plane)
            rest, found = rest[~near], found + 1
        counts.append(found)
    none = torch.zeros((0, 4), dtype=torch.float64, device=points.device)
    return torch.cat([none, *planes]), ptr_from_counts(counts, device=ptr.device), label


@op(
    points="N 3",
    ptr="ptr N B >= 3",
    distance=checked_length,
    num_hypotheses=checked_count,
    seed=checked_seeds,
    up=checked_up,
    max_tilt=checked_tilt,
    probability=checked_probability,
    max_planes=checked_count,
    min_share=checked_fraction,
    likely_up=checked_up,
    viewpoint=checked_places,
    steps=(draw_planes, bound_runs, record_planes, near_planes, fit_planes, nearest_rows, density_clusters),
    gradient=False,
)
def supporting_plane(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    distance: float = 0.01,
    num_hypotheses: int = 1000,
    seed: int | Sequence[int] | Tensor = 0,
    up: Tensor | Sequence[float] | None = None,
    max_tilt: float | None = None,
    probability: float | None = None,
    likely_up: Tensor | Sequence[float] | None = None,
    viewpoint: Tensor | Sequence[float] | None = None,
    max_planes: int = 8,
    min_share: float = 0.03,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # planes (B, 4) float64, inlier_mask (N,) bool
    """Find the plane of each cloud that things stand on: the table, rather than a larger wall or the top of a box.

    The planes of a cloud (:func:`segment_planes`) are found among the means of its voxels of edge 2 ``distance``, so
    what counts is area, however near the sensor or however often seen. Each scores its area, times one more than the
    area of what stands on it, times how level it is: 0.1 + max(0, cosine of its normal and up); the highest wins, the
    first found of equals. What stands on a plane is what is left without any plane, in connected parts that reach down
    to it, above it and over its convex hull, less what noise puts below it. The winner is refitted to its inliers, of
    65,536 points at most, until they no longer change.

    The result is that of :func:`ransac_plane`: normals along ``up`` where given, else toward the viewpoint.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        distance: in the unit of the points; what is nearer to a plane belongs to it.
        num_hypotheses: as in :func:`ransac_plane`, for every plane.
        seed: as there.
        up: as there.
        max_tilt: as there.
        probability: as there.
        likely_up: a direction that is up more or less, (3,) or (B, 3), where up is not known: (0, -1, -0.3) of a camera
            held upright; it only weighs planes.
        viewpoint: where the sensor stood, (3,) or (B, 3); None = the origin.
        max_planes: planes that are looked at.
        min_share: of the voxels that a plane must hold.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        TooFewPointsError: a cloud has fewer than 3 points.
        UnitError: a cloud is more than a million times longer than ``distance``.
        NoPlaneError: no plane holds ``min_share`` of a cloud's voxels, within the tilt limit.
        ConfigError: a parameter out of range, or ``max_tilt`` without ``up``.
    """
    assert ptr is not None  # @op fills it
    assert isinstance(seed, list)  # and makes these one per cloud
    assert up is None or isinstance(up, Tensor)
    assert likely_up is None or isinstance(likely_up, Tensor)
    assert viewpoint is None or isinstance(viewpoint, Tensor)
    search = {"distance": distance, "num_hypotheses": num_hypotheses, "max_tilt": max_tilt, "probability": probability}
    winners, samples = [], []
    for b, (start, stop) in enumerate(pairwise(ptr.tolist())):
        own = points[start : stop : max(1, math.ceil((stop - start) / _SAMPLE))]
        span = max(float(along.max() - along.min()) for along in own.T.contiguous()) / distance
        if span > _MOST_SPAN:
            raise UnitError(
                f"supporting_plane: cloud {b} spans {span:.3g} times distance={distance:g}, more than {_MOST_SPAN:g}; "
                "is distance in the unit of the points, and are there stray points?"
            )
        means, _, _ = voxel_downsample(own, voxel_size=2 * distance)
        own_up = None if up is None else up[b]
        planes, _, label = segment_planes(
            means,
            seed=seed[b],
            up=own_up,
            max_planes=max_planes,
            min_share=min_share,
            backend=backend,
            **search,  # type: ignore[arg-type]
        )
        if not len(planes):
            limit = "" if max_tilt is None else " within max_tilt of up"
            raise NoPlaneError(
                f"supporting_plane: cloud {b}: no plane{limit} holds {min_share:g} of its {len(means)} voxels of "
                f"{2 * distance:g}; is the table in the cloud, and distance in its unit?"
            )
        seen_from = torch.zeros(3, dtype=torch.float64, device="cpu") if viewpoint is None else viewpoint[b].cpu()
        planes = _turned(planes.cpu(), own_up, seen_from)
        toward = own_up if own_up is not None else None if likely_up is None else likely_up[b].cpu()
        scores = _scores(means, label, planes, toward, distance, backend)
        winners.append(planes[int(scores.argmax())])
        samples.append(own)
    sampled = torch.cat(samples)
    sampled_ptr = ptr_from_counts([len(own) for own in samples], device=ptr.device)
    chosen = torch.stack(winners)
    refined, _ = refined_planes(sampled, sampled_ptr, chosen.clone(), distance, up, max_tilt, backend)
    # Refitted normals have any sign; they stay on the side that was chosen.
    refined = torch.where((refined[:, :3] * chosen[:, :3]).sum(1, keepdim=True) < 0, -refined, refined)
    return refined.to(points.device), near_planes(points, ptr, refined, distance, backend=backend)


def _turned(planes: Tensor, up: Tensor | None, seen_from: Tensor) -> Tensor:
    """Turn the normals (P, 4) along up, else toward where the sensor stood."""
    side = planes[:, :3] @ seen_from + planes[:, 3] if up is None else planes[:, :3] @ up
    return torch.where((side < 0)[:, None], -planes, planes)


def _standing(height: Tensor, over: Tensor, part: Tensor, distance: float) -> int:
    """Count the voxels above a plane, over its hull, of parts that reach down to it and rise from it."""
    above = over & (height > 0)
    nothing = torch.zeros(int(part.max()) + 1, dtype=torch.bool, device=height.device)
    # What is no higher than this may be noise of the plane.
    rises = nothing.index_put((part[above & (height > 3 * distance)],), nothing.new_ones(()))
    touches = nothing.index_put((part[above & (height < 4 * distance)],), nothing.new_ones(()))
    return int((above & (rises & touches)[part]).sum())


def _scores(
    voxels: Tensor, label: Tensor, planes: Tensor, up: Tensor | None, distance: float, backend: str
) -> Tensor:  # (P,) float64 on the CPU
    """Score planes by their area, by what stands on them and by how level they are."""
    if len(planes) == 1:
        return torch.ones(1, dtype=torch.float64, device="cpu")
    rest = voxels[label < 0]
    part = torch.zeros(0, dtype=torch.int64, device=voxels.device)
    if len(rest):  # two edges of a voxel: neighbors over a corner
        part = dbscan(rest, eps=4 * distance, min_points=1, backend=backend)
    scores = []
    for number, plane in enumerate(planes.to(voxels.device)):
        own = voxels[label == number]
        standing = 0
        if len(rest):
            height = rest.double() @ plane[:3] + plane[3]
            over = over_hull(rest, own, plane, 2 * distance)
            # Noise of the plane lies above it as below it; nothing stands below.
            standing = max(0, _standing(height, over, part, distance) - _standing(-height, over, part, distance))
        level = 1.0 if up is None else _LEAST_LEAN + max(0.0, float(plane[:3].cpu() @ up))
        scores.append(len(own) * (1 + standing) * level)
    return torch.tensor(scores, dtype=torch.float64, device="cpu")
