"""Tables, walls and boxes as points of which the truth is known; z is up, metres."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pcdata.rng import seeded

TABLE: dict[str, Any] = {"corner": (-0.5, -0.5, 0.0), "along": (1.0, 0.0, 0.0), "across": (0.0, 1.0, 0.0)}
# Behind the table, higher and wider than it.
WALL: dict[str, Any] = {"corner": (0.6, -1.0, 0.0), "along": (0.0, 2.0, 0.0), "across": (0.0, 0.0, 1.5), "count": 9000}


def rectangle(
    corner: Sequence[float],
    along: Sequence[float],
    across: Sequence[float],
    *,
    seed: int = 0,
    count: int = 3000,
    noise: float = 0.001,
) -> Tensor:  # (count, 3)
    """Random points of a rectangle, with normal noise across it."""
    generator = seeded(seed)
    start, one, two = (torch.tensor(vector, dtype=torch.float64) for vector in (corner, along, across))
    places = torch.rand(count, 2, generator=generator, dtype=torch.float64)
    normal = torch.linalg.cross(one, two)
    off = noise * torch.randn(count, 1, generator=generator, dtype=torch.float64) * normal / normal.norm()
    return (start + places[:, :1] * one + places[:, 1:] * two + off).float()


def box(base: Sequence[float], size: Sequence[float], *, seed: int = 0, count: int = 1500) -> Tensor:
    """Top and four sides of a box whose bottom has its center at ``base``, as many points as each face is large."""
    (x, y, z), (length, width, height) = base, size
    low, high = (x - length / 2, y - width / 2, z), (x + length / 2, y + width / 2, z + height)
    faces = [
        ((low[0], low[1], high[2]), (length, 0, 0), (0, width, 0)),
        (low, (length, 0, 0), (0, 0, height)),
        (low, (0, width, 0), (0, 0, height)),
        ((high[0], high[1], low[2]), (-length, 0, 0), (0, 0, height)),
        ((high[0], high[1], low[2]), (0, -width, 0), (0, 0, height)),
    ]
    areas = [length * width, length * height, width * height, length * height, width * height]
    counts = [max(1, round(count * area / sum(areas))) for area in areas]
    return torch.cat([rectangle(*face, seed=seed, count=some, noise=5e-4) for face, some in zip(faces, counts)])


def seen_from_camera(points: Tensor, pitch: float, *, distance: float = 1.5) -> Tensor:
    """The points in the axes of a camera that looks at the origin along +x, down by ``pitch`` radians."""
    down, level = math.sin(pitch), math.cos(pitch)
    rows = [[0.0, -1.0, 0.0], [-down, 0.0, -level], [level, 0.0, -down]]  # right, down, forward
    turned = points.double() @ torch.tensor(rows, dtype=torch.float64).T
    return (turned + torch.tensor([0.0, 0.0, distance], dtype=torch.float64)).float()
