"""A cloud as pixels: points as squares that hide what lies behind them, shaded so that depth is seen.

Squares come from our own z-buffer, :func:`pcdata.functional.render_points`. Rims are darkened where what is near hides
what is far: eye-dome lighting (Boucheny, 2009). Where there are normals a lamp stands beside the eye.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.functional.neighbors import knn
from pcdata.functional.rendering import render_points
from pcdata.report.figures.coloring import Coloring, coloring_of
from pcdata.report.html.scene import Lines, Stage
from pcdata.report.html.unpacking import UnpackedCloud, unpack_cloud

_FINER = 2  # pixels rendered for one of the picture, along each side: no jagged rims
_FIELD = np.deg2rad(45.0)  # of view, as the viewer has it
_MARGIN = 0.04  # of the picture, on each side
_MOST_WIDE = 0.03  # of the picture: one point
_STRAY = 8  # times as far from its neighbors as most points are: no part of a surface
_SHADE = 0.9  # of a rim that hides something far
_PIECES = 48  # of a segment, each drawn or hidden by itself
_SLACK = 0.01  # of the extent: lines lie on surfaces


@dataclass(frozen=True)
class CloudPicture:
    """A rendered cloud.

    Args:
        image: (H, W, 4) uint8; clear where nothing is.
        coloring: what its colors mean.
        lines: (name, color, (S, 2, 2) ends in pixels, (S,) which are hidden by points).
    """

    image: NDArray[np.uint8]
    coloring: Coloring
    lines: tuple[tuple[str, str, NDArray[np.float64], NDArray[np.bool_]], ...]


def cloud_picture(stage: Stage, *, color: str | None, size: tuple[int, int], point_size: float | None) -> CloudPicture:
    """Render a cloud from where the page's viewer looks at first, filling the picture.

    Args:
        stage: the cloud and the lines around it.
        color: what points are colored by; None = the best that there is.
        size: (height, width) pixels.
        point_size: of a point in the cloud's unit; None = what closes its surfaces.

    Raises:
        ConfigError: the cloud has nothing of the name ``color``.
    """
    cloud, said = unpack_cloud(stage.cloud), stage.cloud.said
    coloring = coloring_of(cloud, color, np.array(said["up"]))
    eye = _Eye.at(said["view"], cloud.points, size)
    if not len(cloud.points):
        return CloudPicture(np.zeros((*size, 4), np.uint8), coloring, ())
    seen = torch.from_numpy(eye.seen(cloud.points)).float()
    most = _MOST_WIDE * _FINER * size[0] * eye.away / float(eye.finer[0, 0])
    wide = _widths(seen) if point_size is None else np.full(len(seen), point_size / eye.radius)
    depth, front = _front(seen, np.clip(wide, 1e-9, most), eye, size)
    found = front < len(cloud.points)
    shade = _rims(depth) * _lamp(cloud, front, found, eye)
    image = np.zeros((*front.shape, 4))
    image[found, :3] = coloring.colors[front[found]] * shade[found, None]
    image[found, 3] = 255
    lines = tuple(_drawn(one, eye, depth) for one in stage.lines if len(one.segments))
    return CloudPicture(_reduced(image), coloring, lines)


@dataclass(frozen=True)
class _Eye:
    """A pinhole camera that sees all, in a unit in which the cloud's radius is 1."""

    center: NDArray[np.float64]
    radius: float
    turn: NDArray[np.float64]  # (3, 3) rows right, down, forward
    away: float  # of the center
    finer: NDArray[np.float64]  # (3, 3) intrinsics of the finer image

    @classmethod
    def at(cls, view: dict[str, list[float]], points: NDArray[np.float64], size: tuple[int, int]) -> _Eye:
        low, high, up = (np.array(view[name]) for name in ("lower", "upper", "up"))
        radius = max(float(np.linalg.norm(high - low)) / 2, 1e-9)
        forward = -np.array(view["toward"]) / np.linalg.norm(view["toward"])
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward])
        away = 1.1 / np.sin(_FIELD / 2)
        eye = cls((low + high) / 2, radius, turn, away, np.eye(3))
        height, width = (_FINER * side for side in size)
        inside = points[((points >= low - 1e-9) & (points <= high + 1e-9)).all(1)]
        seen = eye.seen(inside if len(inside) else np.stack([low, high]))
        ends = seen[:, :2] / seen[:, 2:]
        first, last = ends.min(0), ends.max(0)
        extent = np.maximum(last - first, 1e-3)
        focal = (1 - 2 * _MARGIN) * min(width / extent[0], height / extent[1])
        middle = np.array([width - 1, height - 1]) / 2 - focal * (first + last) / 2
        k = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1.0]])
        return cls(eye.center, radius, turn, away, k)

    def seen(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points in the frame of the eye."""
        return (points - self.center) / self.radius @ self.turn.T + [0, 0, self.away]


def _widths(seen: torch.Tensor) -> NDArray[np.float64]:
    """Return how wide each point must be to close its surface: somewhat more than its neighbors are apart.

    A stray lies far from a surface whose points lie close: it is as wide as they are, not as its own distance.
    """
    if len(seen) < 8:
        return np.full(len(seen), 0.02)
    index, apart = knn(seen, k=4)
    own = apart[:, -1]
    index = index.clamp(max=len(seen) - 1)  # one so far away that a float cannot tell has no neighbor
    widths = 1.25 * torch.minimum(own, 1.3 * own[index[:, 1:]].amin(1)).double().numpy()
    usual = max(float(np.median(widths)), 1e-9)
    return np.where(widths > _STRAY * usual, usual, np.maximum(widths, usual / _STRAY))


def _front(
    seen: torch.Tensor, widths: NDArray[np.float64], eye: _Eye, size: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the depth (H, W) of what is in front, infinite where nothing is, and its point, N there.

    Points are rendered in classes of one width each, a half wider from one to the next.
    """
    shape = (_FINER * size[0], _FINER * size[1])
    depth, front = np.full(shape, np.inf), np.full(shape, len(seen), dtype=np.int64)
    classes = np.ceil(np.log(widths) / np.log(1.5)).astype(np.int64)
    for each in np.unique(classes):
        rows = np.flatnonzero(classes == each)
        spots = render_points(
            seen[torch.from_numpy(rows)],
            intrinsics=torch.from_numpy(eye.finer[None]),
            size=shape,
            point_size=float(widths[rows].max()),
        )
        own, index = spots.depth[0].double().numpy(), spots.point_index[0].numpy()
        nearer = (index < len(rows)) & (own < depth)
        depth[nearer], front[nearer] = own[nearer], rows[index[nearer]]
    return depth, front


def _rims(depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the light (H, W) that is left where neighbors a few pixels away are nearer."""
    logs = np.log(depth)
    darker = np.zeros_like(depth)
    reach = _FINER
    directions = [(0, reach), (reach, 0), (0, -reach), (-reach, 0), (reach, reach), (-reach, -reach)]
    with np.errstate(invalid="ignore"):
        for down, right in directions:
            beside = np.roll(logs, (down, right), axis=(0, 1))
            step = np.where(np.isfinite(beside), logs - beside, 0.0)
            darker += np.clip(np.nan_to_num(step, nan=0.0, posinf=0.0), 0, 0.08)
    return 1 - _SHADE * (1 - np.exp(-18 * darker / len(directions)))


def _lamp(cloud: UnpackedCloud, front: NDArray[np.int64], found: NDArray[np.bool_], eye: _Eye) -> NDArray[np.float64]:
    light = np.ones(front.shape)
    if cloud.kinds.get("normals") == "normal":
        normals = (cloud.fields["normals"].astype(np.float64) - 127.5) / 127.5
        lamp = eye.turn.T @ np.array([-0.35, -0.5, -0.8])  # above the eye and to its left
        facing = np.abs(normals @ (lamp / np.linalg.norm(lamp)))  # a surface has two sides
        light[found] = 0.45 + 0.55 * facing[front[found]]
    return light


def _reduced(image: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Average the finer pixels of each one, in which each color counts as much as it covers."""
    height, width = image.shape[0] // _FINER, image.shape[1] // _FINER
    blocks = image.reshape(height, _FINER, width, _FINER, 4)
    cover = blocks[..., 3:].sum((1, 3))
    colors = (blocks[..., :3] * blocks[..., 3:]).sum((1, 3)) / np.maximum(cover, 1)
    return np.concatenate([colors, cover / _FINER**2], axis=2).round().astype(np.uint8)


def _drawn(
    lines: Lines, eye: _Eye, depth: NDArray[np.float64]
) -> tuple[str, str, NDArray[np.float64], NDArray[np.bool_]]:
    """Return the pieces of segments that lie before the eye, in pixels, and which of them points hide."""
    ends = eye.seen(lines.segments).reshape(-1, 2, 3)
    along = np.linspace(0, 1, _PIECES + 1)[None, :, None]
    places = ends[:, :1] + along * (ends[:, 1:] - ends[:, :1])
    pieces = np.stack([places[:, :-1], places[:, 1:]], axis=2).reshape(-1, 2, 3)
    pieces = pieces[(pieces[:, :, 2] > 0.05 * eye.away).all(1)]
    pixels = pieces @ eye.finer.T
    pixels = pixels[..., :2] / pixels[..., 2:]
    height, width = depth.shape
    column, row = np.rint(pixels.mean(1)).T.astype(np.int64)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    hidden = np.zeros(len(pieces), dtype=bool)
    hidden[inside] = pieces[inside, :, 2].mean(1) > depth[row[inside], column[inside]] + _SLACK
    pixels = (pixels + 0.5) / _FINER - 0.5
    return lines.name, lines.color, pixels[inside], hidden[inside]
