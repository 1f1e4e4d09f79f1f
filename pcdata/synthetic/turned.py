"""Solids of revolution with any profile: bowls and mugs, which are hollow, bottles and cones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.errors import ConfigError
from pcdata.synthetic.shapes import Shape

Profile = tuple[tuple[float, float], ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class Turned(Shape):
    """A closed polygon turned about the object's own z axis.

    Args:
        profile: its corners (radius, z) in metres, counterclockwise with the radius to the right: what is left of each
            edge is inside. Edges on the axis are no surface.

    Raises:
        ConfigError: fewer than three corners, a radius below 0, or corners that run clockwise.
    """

    profile: Profile

    def __post_init__(self) -> None:
        corners = self.profile
        area = sum(r * next_z - next_r * z for (r, z), (next_r, next_z) in _edges(corners)) / 2
        if len(corners) < 3 or min(r for r, _ in corners) < 0 or not area > 0:
            raise ConfigError(
                f"Turned: profile needs three corners (radius, z) and more, no radius below 0, counterclockwise, got "
                f"{len(corners)} corners around {area:.3g} m2; reverse them where the area is below 0"
            )

    @property
    def bounding_radius(self) -> float:
        """From the origin to the farthest corner."""
        return max(math.hypot(r, z) for r, z in self.profile)

    def _entry(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        origins, directions = torch.broadcast_tensors(origins, directions)
        first = directions.new_full((len(directions),), math.inf)
        normals = torch.zeros_like(directions)
        for (r, z), (next_r, next_z) in _edges(self.profile):
            if r == next_r == 0:
                continue
            run, rise = next_r - r, next_z - z
            length = math.hypot(run, rise)
            # The cone (x, y, z) with radius * rise == r * rise + run * (height - z), squared; a plane where rise is 0.
            for t in _crossings(origins, directions, r * rise - z * run, run, rise, z):
                met = origins + t[:, None] * directions
                radius = met[:, :2].norm(dim=1)
                along = ((radius - r) * run + (met[:, 2] - z) * rise) / length
                off = ((radius - r) * rise - (met[:, 2] - z) * run) / length  # the other half of the double cone
                own = (t > 0) & (t < first) & (along >= 0) & (along <= length) & (off.abs() < 1e-9)
                out = (
                    torch.cat([met[:, :2] / radius.clamp(min=1e-12)[:, None] * rise, met[:, 2:] * 0 - run], 1) / length
                )
                first = torch.where(own, t, first)
                normals = torch.where(own[:, None], out, normals)
        # Whoever leaves the solid first was inside.
        outside = (normals * directions).sum(1) < 0
        return torch.where(outside, first, math.inf), normals

    def _signed_distance(self, points: Tensor) -> Tensor:
        flat = torch.stack([points[:, :2].norm(dim=1), points[:, 2]], dim=1)
        nearest = points.new_full((len(points),), math.inf)
        inside = torch.zeros_like(nearest, dtype=torch.bool)
        for one, other in _edges(self.profile):
            start, way = points.new_tensor(one), points.new_tensor(other) - points.new_tensor(one)
            part = ((flat - start) @ way / (way @ way)).clamp(0, 1)
            if not one[0] == other[0] == 0:
                nearest = torch.minimum(nearest, (flat - start - part[:, None] * way).norm(dim=1))
            # A ray to the right crosses the edge: even-odd rule.
            between = (one[1] > flat[:, 1]) != (other[1] > flat[:, 1])
            at = one[0] + (flat[:, 1] - one[1]) / (other[1] - one[1] or 1.0) * (other[0] - one[0])
            inside ^= between & (flat[:, 0] < at)
        return torch.where(inside, -nearest, nearest)


def bowl_profile(radius: float, depth: float, wall: float, parts: int = 8) -> Profile:
    """Return the profile of a bowl that stands on z = -depth/2: part of a sphere, open above.

    Args:
        radius: of the rim, outside.
        depth: of the whole bowl.
        wall: how thick it is.
        parts: edges of each side.
    """
    ball = (radius * radius + depth * depth) / (2 * depth)
    angles = [math.asin(min(1.0, radius / ball)) * part / parts for part in range(parts + 1)]
    if depth > radius:
        angles = [(math.pi - math.asin(radius / ball)) * part / parts for part in range(parts + 1)]
    outside = [(ball * math.sin(a), ball * (1 - math.cos(a)) - depth / 2) for a in angles]
    inner = ball - wall
    inside = [(inner * math.sin(a), ball - inner * math.cos(a) - depth / 2) for a in reversed(angles)]
    return (*_standing(outside, radius / 3), *inside)


def mug_profile(radius: float, height: float, wall: float) -> Profile:
    """Return the profile of a mug without a handle, from -height/2 to height/2, as thick at the foot as at the wall."""
    low, high, inner = -height / 2, height / 2, radius - wall
    return ((0.0, low), (radius, low), (radius, high), (inner, high), (inner, low + wall), (0.0, low + wall))


def _standing(outside: Sequence[tuple[float, float]], foot: float) -> list[tuple[float, float]]:
    """Cut the round bottom of a bowl flat, that wide."""
    low = outside[0][1]
    return [(0.0, low), (foot, low), *[corner for corner in outside if corner[0] > 1.2 * foot]]


def _edges(corners: Profile) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    return list(zip(corners, (*corners[1:], corners[0])))


def _crossings(
    origins: Tensor, directions: Tensor, offset: float, run: float, rise: float, z: float
) -> tuple[Tensor, ...]:
    """Return where rays meet the cone radius * rise == offset + run * height, or the plane of height z."""
    if rise == 0:
        height = directions[:, 2]
        return (torch.where(height != 0, (z - origins[:, 2]) / torch.where(height != 0, height, 1.0), math.inf),)
    base = offset + run * origins[:, 2]
    a = rise * rise * directions[:, :2].square().sum(1) - (run * directions[:, 2]).square()
    b = rise * rise * (origins[:, :2] * directions[:, :2]).sum(1) - run * base * directions[:, 2]
    c = rise * rise * origins[:, :2].square().sum(1) - base.square()
    found = b * b - a * c
    root = found.clamp(min=0).sqrt()
    safe = torch.where(a != 0, a, 1.0)
    linear = torch.where((a == 0) & (b != 0), -c / (2 * torch.where(b != 0, b, 1.0)), math.inf)
    ends = (((-b - root) / safe), ((-b + root) / safe))
    return tuple(torch.where(found < 0, math.inf, torch.where(a != 0, end, linear)) for end in ends)
