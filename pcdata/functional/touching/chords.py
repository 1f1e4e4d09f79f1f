"""Lines between points of a scene that cameras see through: what such a line joins is hardly one object.

Source: Lien and Amato, Approximate convex decomposition of polyhedra, CAGD 2007 (what is nearly convex is one part);
here free space takes the place of the surface, of which scans see a part.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.functional.touching.basins import Basins
from pcdata.functional.touching.faces import Scene

# Metres. Shorter lines lie within what smoothing rounds off; longer ones are of no use to join what touches.
_SHORTEST, _LONGEST = 0.02, 0.25
_ALONG = 8  # points on each line
_ENDS = 0.15  # of a line, on both sides: there it leaves the surface
_CLEAR, _DEVIATIONS = 0.008, 3.0  # metres, and deviations of a reading, whichever is more: so far before what is seen
_EMPTY = 3  # pixels: what is lost at edges, and here and there, is less
_AGREE = 2  # views: where one read nothing, something nearer may have been removed, as a robot
_FREE = 0.2  # of the points on a line
_AT_ONCE = 1 << 17  # lines


class Sight(NamedTuple):
    """What one camera saw, to tell where nothing is."""

    scene: Scene
    camera_from_points: Tensor | None  # (4, 4)

    @property
    def empty(self) -> Tensor:
        """(H * W,) where nothing was read far around: the table that was removed, or what is beyond it."""
        there = (self.scene.inverse > 0)[None].double()
        window = 2 * _EMPTY + 1
        return torch.nn.functional.max_pool2d(there, window, 1, _EMPTY).flatten() == 0


class Chords(NamedTuple):
    """Lines between points."""

    first: Tensor  # (L,) int64
    second: Tensor  # (L,) int64, larger
    free: Tensor  # (L,) bool, a camera sees through it


def free_chords(
    points: Tensor,  # (M, 3) float64
    heights: Tensor | None,  # (M,) float64 above the table
    sights: Sequence[Sight],
    basins: Basins | None = None,
) -> Chords:
    """Return lines between all points that are neither next to each other nor far, and whether any camera sees through.

    Lines that are free only inside of bowls tell nothing and are left out.
    """
    first, second = _pairs(points)
    part = torch.linspace(_ENDS, 1 - _ENDS, _ALONG, dtype=torch.float64, device=points.device)[None, :, None]
    empty = [sight.empty for sight in sights]
    found = []
    for a, b in zip(first.split(_AT_ONCE), second.split(_AT_ONCE)):
        between = (points[a][:, None] + part * (points[b] - points[a])[:, None]).reshape(-1, 3)
        clear = torch.zeros(len(between), dtype=torch.bool, device=points.device)
        through = torch.zeros(len(between), dtype=torch.int64, device=points.device)
        for sight, nothing in zip(sights, empty):
            before, beyond = _sees_through(sight, nothing, between)
            clear |= before
            through += beyond
        clear |= through >= _AGREE
        held = torch.zeros_like(clear)
        if basins is not None and heights is not None:
            level = heights[a][:, None] + part[..., 0] * (heights[b] - heights[a])[:, None]
            held = clear & basins.hold(between, level.reshape(-1))
        free, hollow = ((one.reshape(-1, _ALONG).double().mean(1) > _FREE) for one in (clear & ~held, held))
        known = free | ~hollow
        found.append(Chords(a[known], b[known], free[known]))
    return Chords(*(torch.cat(parts) for parts in zip(*found)))


def _pairs(points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the pairs of points that are as far apart as lines may be long."""
    none = torch.empty(0, dtype=torch.int64, device=points.device)
    firsts, seconds = [none], [none]
    for start in range(0, len(points), 1024):
        apart = torch.cdist(points[start : start + 1024], points[start:])
        a, b = ((apart > _SHORTEST) & (apart < _LONGEST)).nonzero().unbind(1)
        upper = b > a
        firsts.append(a[upper] + start)
        seconds.append(b[upper] + start)
    return torch.cat(firsts), torch.cat(seconds)


def _sees_through(sight: Sight, empty: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Mark points (K, 3) that are clearly nearer than what is seen in their pixels, and where nothing is."""
    scene, camera = sight.scene, sight.scene.camera
    height, width = scene.inverse.shape
    if sight.camera_from_points is not None:
        points = points @ sight.camera_from_points[:3, :3].T + sight.camera_from_points[:3, 3]
    z = points[:, 2]
    safe = z.clamp(min=1e-6)
    u = (points[:, 0] / safe * camera.fx + camera.cx).round().to(torch.int64)
    v = (points[:, 1] / safe * camera.fy + camera.cy).round().to(torch.int64)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (z > 0)
    pixel = torch.where(inside, v * width + u, 0)
    found = scene.inverse.flatten()[pixel]
    seen = inside & (found > 0)
    depth = 1 / torch.where(seen, found, 1.0)
    limit = (_DEVIATIONS * scene.noise * z * z).clamp(min=_CLEAR)
    return seen & (depth - z > limit), inside & empty[pixel]
