"""What RemovePlane says of the planes it found: kept in the source frame, so that no later step makes it stale."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.contracts.on_host import counts_of
from pcdata.structures import PointCloud

plane_guesses: ContextVar[tuple[Mapping[str, Any], ...]] = ContextVar("plane_guesses", default=())

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
    planes = np.full((cloud.num_clouds, 4), np.nan)
    for b in range(cloud.num_clouds):
        place = len(cloud.meta[b].get("planes", []))
        if place < len(guesses) and guesses[place]["frame"] == cloud.source_frame:
            told = np.array([[*guesses[place]["normal"], guesses[place]["offset"]]])
            planes[b] = _mapped(told, cloud.source_from_cloud[b : b + 1].cpu().numpy())
    return torch.from_numpy(planes)


def map_planes(planes: Tensor, old_from_new: Tensor) -> Tensor:
    """Rewrite (P, 4) planes in new coordinates, by (P, 4, 4) matrices on the CPU: a plane moves by the inverse one."""
    return torch.from_numpy(_mapped(planes.double().numpy(), old_from_new.numpy()))


def _mapped(planes: NDArray[np.float64], old_from_new: NDArray[np.float64]) -> NDArray[np.float64]:
    """Multiply planes, as row vectors, with matrices, and make their normals unit vectors again."""
    moved: NDArray[np.float64] = (planes[:, :, None] * old_from_new).sum(1)
    x, y, z = moved[:, 0], moved[:, 1], moved[:, 2]
    with np.errstate(invalid="ignore"):  # no direction stays none
        return moved / np.sqrt(x * x + y * y + z * z)[:, None]


Surfaces = tuple[NDArray[np.floating], Tensor, Tensor]  # places of corners (B, C, 3), their rows, -1 = none, RMS (B,)


def surfaces_seen(points: Tensor, corners: Tensor, rms: Tensor) -> Surfaces:
    """Return what is told of surfaces whose corners are rows of the points."""
    return _places(points, corners), corners, rms


def plane_facts(
    cloud: PointCloud,
    planes: NDArray[np.float64],  # (B, 4) in the clouds' coordinates
    num_inliers: Tensor,  # (B,) points near each, of walls that cross it too
    surfaces: Callable[[], Surfaces],
) -> Callable[[], list[dict[str, Any]]]:
    """Return what finds out what is stored of each cloud's plane: itself, its share, its spread, and its hull.

    All in the source frame. Of the cloud nothing is kept in memory but by ``surfaces``.
    """
    matrices, counts, frame = cloud.source_from_cloud.cpu().numpy().copy(), counts_of(cloud.ptr), cloud.source_frame

    def facts() -> list[dict[str, Any]]:
        places, corners, rms = surfaces()
        source_planes = _mapped(planes, np.linalg.inv(matrices))
        hulls = _hulls(places, planes, matrices).round(_DIGITS).tolist()
        num_corners = np.count_nonzero(corners.numpy() >= 0, axis=1).tolist()
        return [
            {
                "normal": plane[:3],
                "offset": plane[3],
                "frame": frame,
                "num_inliers": inliers,
                "inlier_share": inliers / max(count, 1),
                "rms": spread,
                "hull": hull[:num],
            }
            for plane, inliers, count, spread, hull, num in zip(
                source_planes.tolist(), num_inliers.tolist(), counts, rms.tolist(), hulls, num_corners
            )
        ]

    return facts


def _places(points: Tensor, corners: Tensor) -> NDArray[np.floating]:  # (B, C, 3)
    """Return where the corners are; anything where there is none."""
    if not points.shape[0]:
        return np.zeros((*corners.shape, 3))
    if points.device.type == "cpu":
        return points.numpy()[corners.numpy()]
    return points[corners.to(points.device)].cpu().numpy()


def _hulls(
    corners: NDArray[np.floating], planes: NDArray[np.float64], source_from_cloud: NDArray[np.float64]
) -> NDArray[np.float64]:  # (B, C, 3)
    """Return the corners moved onto the planes, in the source frame."""
    places = corners.astype(np.float64)
    normals, offsets = planes[:, None, :3], planes[:, None, 3:]
    flat = places - ((places * normals).sum(2, keepdims=True) + offsets) * normals
    moved: NDArray[np.float64] = (flat[:, :, None, :] * source_from_cloud[:, None, :3, :3]).sum(3)
    return moved + source_from_cloud[:, None, :3, 3]
