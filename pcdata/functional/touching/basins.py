"""Where water would stand in a scene: inside of bowls, pots and cups.

Source: Barnes, Lehman and Mulla, Priority-flood: an optimal depression-filling and watershed-labeling algorithm for
digital elevation models, Computers & Geosciences 62, 2014 (what filled is; here small maps are relaxed instead).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_EDGE = 0.01  # metres, of the cells of the map
_DEPTH = 0.01  # metres: shallower is noise
_WIDE = 0.6  # of the 3 x 3 cells around one are deep too
_OVER_RIM = 0.015  # metres: the rim itself is as high as its highest point
_MOST_CELLS = 1 << 22  # of a map; where points are spread over more, nothing is held


@dataclass(frozen=True, eq=False)
class Basins:
    """A map of the table: how high water would stand."""

    axes: Tensor  # (3, 2) float64, along the table
    origin: Tensor  # (2,)
    level: Tensor  # (X, Y) metres above the table, of basins and what is beside them; -inf elsewhere

    def hold(self, points: Tensor, heights: Tensor) -> Tensor:
        """Mark points (K, 3) at heights (K,) that are inside of a basin."""
        place = ((points @ self.axes - self.origin) / _EDGE).floor().to(torch.int64)
        size = torch.tensor(self.level.shape, dtype=torch.int64, device=points.device)
        inside = ((place >= 0) & (place < size)).all(1)
        x, y = place.clamp(min=0).minimum(size - 1).unbind(1)
        return inside & (heights < self.level[x, y] + _OVER_RIM)


def find_basins(
    points: Tensor,  # (N, 3) float64 metres
    heights: Tensor,  # (N,) float64 metres above the table
) -> Basins | None:
    """Pour water over all; None where the points do not tell which way is up, or lie too far apart."""
    if len(points) < 4:
        return None
    centered = points - points.mean(0)
    up = torch.linalg.lstsq(centered.T @ centered, centered.T @ (heights - heights.mean())[:, None]).solution[:, 0]
    if not bool((up.norm() - 1).abs() < 0.1):
        return None
    axes = torch.linalg.qr(torch.cat([up[:, None], torch.eye(3, dtype=up.dtype, device=up.device)], 1))[0][:, 1:]
    flat = points @ axes
    origin = flat.amin(0) - 1.5 * _EDGE
    size = ((flat.amax(0) - origin) / _EDGE).floor().to(torch.int64) + 2
    if int(size.prod()) > _MOST_CELLS:
        return None
    place = ((flat - origin) / _EDGE).floor().to(torch.int64)
    floor = torch.zeros(int(size.prod()), dtype=torch.float64, device=points.device)
    floor.scatter_reduce_(0, place[:, 0] * size[1] + place[:, 1], heights, "amax")
    floor = floor.reshape(int(size[0]), int(size[1]))
    water = _poured(floor)
    # Slots between objects, and readings that fly, are narrow; walls, and what flies inside, belong to their basin.
    is_deep = (water - floor > _DEPTH)[None]
    wide = is_deep & (torch.nn.functional.avg_pool2d(is_deep.double(), 3, 1, 1) > _WIDE)
    level = torch.where(wide, water[None], -torch.inf)
    return Basins(axes, origin, torch.nn.functional.max_pool2d(level, 5, 1, 2)[0])


def _poured(floor: Tensor) -> Tensor:
    """Return the lowest level from which no way over sides of cells leads down to the border of the map."""
    water = torch.full_like(floor, torch.inf)
    water[[0, -1]], water[:, [0, -1]] = floor[[0, -1]], floor[:, [0, -1]]
    while True:
        least = water.clone()
        least[1:-1, 1:-1] = torch.stack(
            [water[:-2, 1:-1], water[2:, 1:-1], water[1:-1, :-2], water[1:-1, 2:], water[1:-1, 1:-1]]
        ).amin(0)
        least = torch.maximum(least, floor)
        if torch.equal(least, water):
            return water
        water = least


__all__ = ["Basins", "find_basins"]
