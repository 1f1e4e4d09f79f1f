"""Convex solids with exact ray hits, normals and signed distances: the whole synthetic world is made of these.

Each solid is written in its own coordinates, centered on the origin; :class:`Shape` carries it to the base frame.
Everything is float64, on the device of the rays or points it is asked about.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

Color = tuple[float, float, float]

# Stands in for a zero divisor: small enough to act as zero, large enough that lengths divided by it stay finite.
_TINY = 1e-150


@dataclass(frozen=True, eq=False, kw_only=True)
class Shape(ABC):
    """A colored solid somewhere in the base frame."""

    base_from_object: Tensor  # (4, 4) float64 rigid; the object's origin is its center
    label: int  # 0 = table, 1.. = objects, -1 = background
    color: Color = (0.7, 0.7, 0.7)  # linear RGB in [0, 1]
    pattern: str = "plain"  # a name known to pcdata.synthetic.shading

    @property
    def center(self) -> Tensor:
        """(3,) float64 center in the base frame."""
        return self.base_from_object[:3, 3]

    @property
    @abstractmethod
    def bounding_radius(self) -> float:
        """The radius in metres of the smallest sphere around the center that holds the solid."""

    def intersect(
        self,
        origins: Tensor,  # (N, 3) or (1, 3), base frame
        directions: Tensor,  # (N, 3) or (1, 3), any length
    ) -> tuple[Tensor, Tensor]:  # (N,) distance in units of the direction's length, inf = miss; (N, 3) unit normals
        """Return where each ray enters the solid, and the outward normal there; a ray from inside misses.

        The normal is that of the face the ray came through, so it never points away from the ray's origin.
        """
        rotation, center = self._pose(directions)
        enter, normals = self._entry((origins - center) @ rotation, directions @ rotation)
        return enter, normals @ rotation.T

    def signed_distance(self, points: Tensor) -> Tensor:
        """Return the (N,) exact distance in metres from (N, 3) base points to the surface, negative inside."""
        return self._signed_distance(self.in_object_frame(points))

    def in_object_frame(self, points: Tensor) -> Tensor:
        """Return (N, 3) base points in the object's own coordinates, in the dtype of the points."""
        rotation, center = self._pose(points)
        return (points - center) @ rotation

    def may_hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Return the rows (M,) int64 of the rays whose line meets the bounding sphere; the others surely miss."""
        offset = self._pose(directions)[1] - origins
        ones = directions.new_ones(3)  # a product with it sums rows four times as fast as vecdot does
        along = (offset * directions) @ ones
        outside = offset.square() @ ones - self.bounding_radius**2
        return (outside * (directions.square() @ ones) <= along * along).nonzero().squeeze(-1)

    def _pose(self, like: Tensor) -> tuple[Tensor, Tensor]:
        pose = self.base_from_object.to(device=like.device, dtype=like.dtype)
        return pose[:3, :3], pose[:3, 3]

    @abstractmethod
    def _entry(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Object frame: the (N,) distance where each ray enters, inf = miss, and the outward normals there."""

    @abstractmethod
    def _signed_distance(self, points: Tensor) -> Tensor:
        """Object frame."""


class ConvexShape(Shape):
    """A solid that a line enters and leaves once."""

    def _entry(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        enter, leave, normals = self._interval(origins, directions)
        return torch.where((enter <= leave) & (enter > 0), enter, math.inf), normals

    @abstractmethod
    def _interval(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Object frame: the (N,) distances where the ray's line enters and leaves (enter > leave = miss), normals."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Box(ConvexShape):
    """A cuboid; ``size`` is its full length in metres along its own x, y, z."""

    size: tuple[float, float, float]

    @property
    def bounding_radius(self) -> float:
        """Half the space diagonal."""
        return math.hypot(*self.size) / 2

    def _half(self, like: Tensor) -> Tensor:
        return torch.tensor(self.size, dtype=like.dtype, device=like.device) / 2

    def _interval(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # Source: Kay & Kajiya, Ray Tracing Complex Scenes, 1986 (the slab method).
        half, away = self._half(directions), _nonzero(directions)
        one, other = (-half - origins) / away, (half - origins) / away
        enter, face = torch.minimum(one, other).max(-1)
        leave = torch.maximum(one, other).amin(-1)
        facing = -torch.sign(away.expand_as(one).gather(-1, face[:, None]))
        return enter, leave, torch.zeros_like(one).scatter(-1, face[:, None], facing)

    def _signed_distance(self, points: Tensor) -> Tensor:
        return _extrusion_distance(points.abs() - self._half(points))


@dataclass(frozen=True, eq=False, kw_only=True)
class Cylinder(ConvexShape):
    """A closed cylinder about its own z axis, from -height/2 to height/2."""

    radius: float
    height: float

    @property
    def bounding_radius(self) -> float:
        """From the center to the rim."""
        return math.hypot(self.radius, self.height / 2)

    def _interval(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        side_in, side_out = _roots(origins[:, :2], directions[:, :2], self.radius)
        z, dz = origins[:, 2], _nonzero(directions[:, 2])
        one, other = (-self.height / 2 - z) / dz, (self.height / 2 - z) / dz
        cap_in, cap_out = torch.minimum(one, other), torch.maximum(one, other)
        enter, leave = torch.maximum(side_in, cap_in), torch.minimum(side_out, cap_out)
        through_side = (side_in >= cap_in)[:, None]
        radial = (origins[:, :2] + enter[:, None] * directions[:, :2]) / self.radius
        axial = -torch.sign(dz).expand_as(enter)[:, None]
        normals = torch.cat([torch.where(through_side, radial, 0.0), torch.where(through_side, 0.0, axial)], dim=-1)
        return enter, leave, normals

    def _signed_distance(self, points: Tensor) -> Tensor:
        beyond_side = points[:, :2].norm(dim=-1) - self.radius
        return _extrusion_distance(torch.stack([beyond_side, points[:, 2].abs() - self.height / 2], dim=-1))


@dataclass(frozen=True, eq=False, kw_only=True)
class Sphere(ConvexShape):
    """A ball of ``radius`` metres."""

    radius: float

    @property
    def bounding_radius(self) -> float:
        """The radius itself."""
        return self.radius

    def _interval(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        enter, leave = _roots(origins, directions, self.radius)
        return enter, leave, (origins + enter[:, None] * directions) / self.radius

    def _signed_distance(self, points: Tensor) -> Tensor:
        return points.norm(dim=-1) - self.radius


def _nonzero(values: Tensor) -> Tensor:
    tiny = max(_TINY, torch.finfo(values.dtype).tiny)
    return torch.where(values.abs() < tiny, tiny, values)


def _roots(origins: Tensor, directions: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Where lines enter and leave the ball |p| <= radius in 2D or 3D; (inf, -inf) where they miss."""
    a = _nonzero((directions * directions).sum(-1))
    b = (origins * directions).sum(-1)
    discriminant = b * b - a * ((origins * origins).sum(-1) - radius**2)
    root = discriminant.clamp(min=0.0).sqrt()
    miss = discriminant < 0
    return torch.where(miss, math.inf, (-b - root) / a), torch.where(miss, -math.inf, (root - b) / a)


def _extrusion_distance(beyond: Tensor) -> Tensor:
    """Signed distance from how far a point lies (N, D) beyond each pair of faces. Source: Quilez, sdBox."""
    return beyond.clamp(min=0.0).norm(dim=-1) + beyond.amax(-1).clamp(max=0.0)
