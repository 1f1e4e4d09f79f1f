"""Several planes of a cloud, and the one among them that things stand on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count, checked_fraction, checked_length, checked_places
from pcdata.contracts.on_host import bounds_of
from pcdata.errors import NoPlaneError, UnitError
from pcdata.functional.clusters import density_clusters
from pcdata.functional.neighbor_rows import nearest_rows
from pcdata.functional.plane_arguments import checked_probability, checked_seeds, checked_tilt, checked_up
from pcdata.functional.plane_choice import chosen_plane
from pcdata.functional.plane_slices import without_slices
from pcdata.functional.plane_steps import near_planes, refine_planes
from pcdata.functional.planes import ransac_plane
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.voxels import voxel_downsample

# Points that tell which planes there are, and refine the one that is chosen.
_SAMPLE = 1 << 16
# Lengths of a cloud, in distances: beyond, float32 does not hold the distances themselves.
_MOST_SPAN = 1e6


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
    steps=(ransac_plane,),
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
    for b, (start, stop) in enumerate(pairwise(bounds_of(ptr))):
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
    steps=(segment_planes, refine_planes, near_planes, nearest_rows, density_clusters),
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
    what counts is area, however near the sensor or however often seen; planes that cut through things lose what they
    cut. Each scores its area, times one more than the
    area of what stands on it, times how level it is: 0.1 + max(0, cosine of its normal and up); the highest wins, the
    first found of equals. What stands on a plane is what is left without any plane, in connected parts that reach down
    to it, above it and over its convex hull, less what noise puts below it. With ``up`` and ``viewpoint``, what is seen
    from below is the front of something, as up is rough: nothing stands on it, and it counts as if it held up. That is
    where it leans by 10 degrees from the most level plane seen from above, and that by less than 60 from up.

    Where nothing stands on the winner, a plane above it and parallel to it within 10 degrees is taken instead, the
    highest below the viewpoint: an empty table, rather than the larger floor around it. It must fill half as much of
    the view as the winner, or an eighth where the winner is seen beneath a tenth of it: the top of a box hides what the
    box stands on. What is no higher than 2 % of the way to it, the noise of a depth camera, does not stand there, nor
    do the legs of that table. The view is that from the viewpoint, and areas count where it is not known: with ``up``
    alone.

    The chosen plane is refitted to its inliers, of 65,536 points at most, until they no longer change.

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
    for b, (start, stop) in enumerate(pairwise(bounds_of(ptr))):
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
        label = without_slices(means, label, planes, distance, backend)
        planes = _turned(planes.cpu(), own_up, seen_from)
        toward = own_up if own_up is not None else None if likely_up is None else likely_up[b].cpu()
        eye = seen_from if viewpoint is not None or up is None else None
        winners.append(planes[chosen_plane(means, label, planes, toward, eye, distance, backend)])
        samples.append(own)
    sampled = torch.cat(samples)
    sampled_ptr = ptr_from_counts([len(own) for own in samples], device=ptr.device)
    chosen = torch.stack(winners)
    refined, _ = refine_planes(sampled, sampled_ptr, chosen, distance, up, max_tilt, backend=backend)
    # Refitted normals have any sign; they stay on the side that was chosen.
    refined = torch.where((refined[:, :3] * chosen[:, :3]).sum(1, keepdim=True) < 0, -refined, refined)
    return refined.to(points.device), near_planes(points, ptr, refined, distance, backend=backend)


def _turned(planes: Tensor, up: Tensor | None, seen_from: Tensor) -> Tensor:
    """Turn the normals (P, 4) along up, else toward where the sensor stood."""
    side = planes[:, :3] @ seen_from + planes[:, 3] if up is None else planes[:, :3] @ up
    return torch.where((side < 0)[:, None], -planes, planes)
