"""What RemovePlane says of the planes it found: kept in the source frame, so that no later step makes it stale."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.functional.plane_patch import flat_places, outline_rows
from pcdata.functional.selection import plane_axes
from pcdata.structures import PointCloud

plane_guesses: ContextVar[tuple[Mapping[str, Any], ...]] = ContextVar("plane_guesses", default=())

_MOST_CORNERS = 24  # of a stored hull: meta is written with every sample
_DIGITS = 5  # of metres: a hundredth of a millimetre


def planes_in_cloud(cloud: PointCloud, b: int = 0) -> Tensor:
    """Return (P, 4) float64 planes (unit normal, offset) found in cloud ``b``, in its present coordinates.

    A point p is on the plane where ``normal @ p + offset == 0``.
    """
    stored = [[*plane["normal"], plane["offset"]] for plane in cloud.meta[b].get("planes", [])]
    planes = torch.tensor(stored, dtype=torch.float64, device="cpu").reshape(-1, 4)
    matrix = cloud.source_from_cloud[b].cpu()
    return map_planes(planes, matrix.expand(len(planes), 4, 4))


def plane_hulls_in_cloud(cloud: PointCloud, b: int = 0) -> list[Tensor]:
    """Return the corners (C, 3) float64 of the hull of each plane's own points, in the cloud's present coordinates.

    They lie on the plane of :func:`planes_in_cloud`, counterclockwise seen from where its normal points to, and are 24
    at most: corners that matter least are left out.
    """
    cloud_from_source = torch.linalg.inv(cloud.source_from_cloud[b].cpu())
    hulls = []
    mirrored = bool(torch.linalg.det(cloud_from_source[:3, :3]) < 0)
    for plane in cloud.meta[b].get("planes", []):
        corners = torch.tensor(plane["hull"], dtype=torch.float64, device="cpu").reshape(-1, 3)
        corners = corners.flip(0) if mirrored else corners
        hulls.append(corners @ cloud_from_source[:3, :3].T + cloud_from_source[:3, 3])
    return hulls


@contextmanager
def guessing_planes(planes: Sequence[Mapping[str, Any]]) -> Iterator[None]:
    """Let RemovePlane begin its searches with planes of another cloud, as ``meta["planes"]`` holds them.

    They are what a stream's frame before had. Each is scored like any other, and a wrong one loses.
    """
    token = plane_guesses.set(tuple(planes))
    try:
        yield
    finally:
        plane_guesses.reset(token)


def guessed_planes(cloud: PointCloud) -> Tensor:
    """Return the planes (B, 4) to begin the search of the next plane with, in the clouds' coordinates; NaN = none."""
    guesses = plane_guesses.get()
    planes = torch.full((cloud.num_clouds, 4), torch.nan, dtype=torch.float64, device="cpu")
    for b in range(cloud.num_clouds):
        place = len(cloud.meta[b].get("planes", []))
        if place < len(guesses) and guesses[place]["frame"] == cloud.source_frame:
            told = torch.tensor(
                [*guesses[place]["normal"], guesses[place]["offset"]], dtype=torch.float64, device="cpu"
            )
            planes[b] = map_planes(told[None], cloud.source_from_cloud[b : b + 1].cpu())[0]
    return planes


def map_planes(planes: Tensor, old_from_new: Tensor) -> Tensor:
    """Rewrite (P, 4) planes in new coordinates: a plane is a row vector, so it moves by the inverse matrix."""
    moved = torch.einsum("pi,pij->pj", planes.double(), old_from_new)
    return moved / moved[:, :3].norm(dim=1, keepdim=True)


def plane_facts(
    points: Tensor,  # (n, 3) of the cloud
    surface: Tensor,  # (n,) bool: the points of its surface
    num_inliers: int,  # points near it, of walls that cross it too
    plane: Tensor,  # (4,) in the cloud's coordinates
    cloud: PointCloud,
    b: int,
) -> dict[str, Any]:
    """Return what is stored of one plane, in the source frame: itself, its share, its spread, and the hull of it."""
    points, plane, source_from_cloud = points.detach(), plane.cpu(), cloud.source_from_cloud[b].cpu()
    (source_plane,) = map_planes(plane[None], torch.linalg.inv(source_from_cloud)[None])
    corners, rms = hull_corners(points, surface, plane)
    moved = corners @ source_from_cloud[:3, :3].T + source_from_cloud[:3, 3]
    return {
        "normal": source_plane[:3].tolist(),
        "offset": float(source_plane[3]),
        "frame": cloud.source_frame,
        "num_inliers": num_inliers,
        "inlier_share": num_inliers / max(len(points), 1),
        "rms": rms,
        "hull": moved.numpy().round(_DIGITS).tolist(),
    }


def hull_corners(points: Tensor, surface: Tensor, plane: Tensor) -> tuple[Tensor, float]:  # (C, 3) float64 on the CPU
    """Return corners of the convex hull of points in a plane, moved onto it, without those that matter least.

    And the RMS distance of the points from it.
    """
    axes = plane_axes(plane).T.contiguous()
    rows, rms = outline_rows(points, surface, plane, axes)
    corners = points[rows].double().cpu()
    corners = corners[_most_corners(flat_places(corners, axes).numpy())]
    return corners - (corners @ plane[:3] + plane[3])[:, None] * plane[:3], rms


def _most_corners(corners: NDArray[np.float64]) -> list[int]:  # (C, 2), in order
    """Say which corners stay: again and again the one goes whose triangle with its neighbors is smallest."""
    kept = list(range(len(corners)))
    places = corners.tolist()
    sizes = [_corner_size(places, kept, at) for at in kept] if len(kept) > _MOST_CORNERS else []
    while len(kept) > _MOST_CORNERS:
        gone = sizes.index(min(sizes))
        del kept[gone], sizes[gone]
        for at in (gone - 1, gone % len(kept)):
            sizes[at] = _corner_size(places, kept, at)
    return kept


def _corner_size(places: list[list[float]], kept: list[int], at: int) -> float:
    """Return twice the area of the triangle of a corner and its neighbors."""
    (left_x, left_y), (x, y), (right_x, right_y) = (places[kept[(at + step) % len(kept)]] for step in (-1, 0, 1))
    return abs((left_x - x) * (right_y - y) - (left_y - y) * (right_x - x))
