"""Spheres, cylinders, lines and circles: through a few points, how far points lie from them, and their least squares.

A shape is a row of float64 numbers: a sphere its center and radius (4,), a line a point and a unit direction (6,), a
cylinder a point of its axis, the axis and the radius (7,), a circle its center, the unit normal of its plane and its
radius (7,). Shapes that points do not determine are NaN. Points and shapes broadcast.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

# Sines and volumes, as parts of what they could be, below which float32 points do not tell a shape.
FLAT = 1e-6

# One residual of every point, and its slope along each way that a shape can change.
Linear = tuple[Tensor, list[Tensor]]


@dataclass(frozen=True)
class Family:
    """All shapes of one kind."""

    name: str
    sample: int  # points, with their normals or without, that determine one
    through: Callable[[Tensor, Tensor | None], Tensor]  # of points and normals (..., sample, 3): (..., K)
    distance: Callable[[Tensor, Tensor], Tensor]  # of points (..., 3) from shapes (..., K): (...)
    linear: Callable[[Tensor, Tensor], list[Linear]]  # of points (M, 3) about their own shapes (M, K)
    moved: Callable[[Tensor, Tensor], Tensor]  # shapes (B, K) by steps (B, D)
    has_radius: bool = True


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the (...,) products of (..., 3) vectors, added in one order."""
    x, y, z = (a * b).unbind(-1)
    return (x + y) + z


def length(vector: Tensor) -> Tensor:
    """Return the (...,) lengths of (..., 3) vectors."""
    return dot(vector, vector).sqrt()


def across(direction: Tensor) -> tuple[Tensor, Tensor]:
    """Return two unit vectors (..., 3) at right angles to unit directions (..., 3) and to each other."""
    axis = torch.nn.functional.one_hot(direction.abs().argmin(-1), 3).to(direction.dtype)
    first = torch.linalg.cross(direction, axis)
    first = first / length(first)[..., None]
    return first, torch.linalg.cross(direction, first)


def _unless(flat: Tensor, shape: Tensor) -> Tensor:
    return shape.masked_fill(flat[..., None] | ~torch.isfinite(shape).all(-1, keepdim=True), torch.nan)


# -- spheres -----------------------------------------------------------------------------------------------------------


def _sphere_through(points: Tensor, normals: Tensor | None) -> Tensor:
    """Return the spheres through four points; or those whose center is nearest to the normals of two."""
    if normals is not None:
        return _sphere_of_two(points, normals)
    a = points[..., 0, :]
    p, q, r = (points[..., other, :] - a for other in (1, 2, 3))
    qr, rp, pq = torch.linalg.cross(q, r), torch.linalg.cross(r, p), torch.linalg.cross(p, q)
    volume = dot(p, qr)
    flat = volume.abs() <= FLAT * length(p) * length(q) * length(r)
    halves = [dot(edge, edge)[..., None] / 2 for edge in (p, q, r)]
    offset = ((halves[0] * qr + halves[1] * rp) + halves[2] * pq) / volume[..., None]
    return _unless(flat, torch.cat([a + offset, length(offset)[..., None]], -1))


def _sphere_of_two(points: Tensor, normals: Tensor) -> Tensor:
    (a, b), (n, m) = points.unbind(-2), normals.unbind(-2)
    between, cosine = b - a, dot(n, m)
    sine = 1 - cosine * cosine
    along_n, along_m = dot(between, n), dot(between, m)
    foot_a = a + ((along_n - cosine * along_m) / sine)[..., None] * n
    foot_b = b + ((cosine * along_n - along_m) / sine)[..., None] * m
    center = (foot_a + foot_b) / 2
    radius = (length(a - center) + length(b - center)) / 2
    return _unless(sine <= FLAT, torch.cat([center, radius[..., None]], -1))


def _sphere_distance(points: Tensor, shape: Tensor) -> Tensor:
    return (length(points - shape[..., :3]) - shape[..., 3]).abs()


def _sphere_linear(points: Tensor, shape: Tensor) -> list[Linear]:
    offset = points - shape[..., :3]
    far = length(offset)
    outward = offset / torch.where(far > 0, far, 1.0)[..., None]
    return [(far - shape[..., 3], [*(-outward).unbind(-1), -torch.ones_like(far)])]


# -- lines -------------------------------------------------------------------------------------------------------------


def _line_through(points: Tensor, _: Tensor | None) -> Tensor:
    """Return the lines through two points."""
    a, b = points.unbind(-2)
    apart = length(b - a)
    return _unless(apart == 0, torch.cat([a, (b - a) / apart[..., None]], -1))


def _line_distance(points: Tensor, shape: Tensor) -> Tensor:
    return length(torch.linalg.cross(points - shape[..., :3], shape[..., 3:6].expand_as(points - shape[..., :3])))


def _line_linear(points: Tensor, shape: Tensor) -> list[Linear]:
    offset, direction = points - shape[..., :3], shape[..., 3:6]
    along, none, one = dot(offset, direction), torch.zeros_like(offset[..., 0]), torch.ones_like(offset[..., 0])
    first, second = across(direction)
    return [
        (dot(offset, first), [-one, none, -along, none]),
        (dot(offset, second), [none, -one, none, -along]),
    ]


def _line_moved(shape: Tensor, step: Tensor) -> Tensor:
    first, second = across(shape[:, 3:6])
    shift = step[:, 0, None] * first + step[:, 1, None] * second
    direction = shape[:, 3:6] + (step[:, 2, None] * first + step[:, 3, None] * second)
    return torch.cat([shape[:, :3] + shift, direction / length(direction)[:, None]], 1)


# -- cylinders ---------------------------------------------------------------------------------------------------------


def _cylinder_through(points: Tensor, normals: Tensor | None) -> Tensor:
    """Return the cylinders of two points and their normals, which the axis is at right angles to."""
    assert normals is not None
    (a, b), (n, m) = points.unbind(-2), normals.unbind(-2)
    normal = torch.linalg.cross(n, m)
    sine = length(normal)
    axis = normal / sine[..., None]
    between = b - a
    along_n = dot(torch.linalg.cross(between, m), axis) / sine
    along_m = dot(torch.linalg.cross(between, n), axis) / sine
    radius = (along_n.abs() + along_m.abs()) / 2
    center = a + along_n[..., None] * n
    return _unless(sine <= FLAT, torch.cat([center, axis, radius[..., None]], -1))


def _cylinder_distance(points: Tensor, shape: Tensor) -> Tensor:
    return (_line_distance(points, shape) - shape[..., 6]).abs()


def _cylinder_linear(points: Tensor, shape: Tensor) -> list[Linear]:
    offset, axis = points - shape[..., :3], shape[..., 3:6]
    along = dot(offset, axis)
    away = offset - along[..., None] * axis
    far = length(away)
    outward = away / torch.where(far > 0, far, 1.0)[..., None]
    first, second = (dot(outward, side) for side in across(axis))
    slopes = [-first, -second, -along * first, -along * second, -torch.ones_like(far)]
    return [(far - shape[..., 6], slopes)]


def _cylinder_moved(shape: Tensor, step: Tensor) -> Tensor:
    return torch.cat([_line_moved(shape, step), shape[:, 6:] + step[:, 4:]], 1)


# -- circles -----------------------------------------------------------------------------------------------------------


def _circle_through(points: Tensor, _: Tensor | None) -> Tensor:
    """Return the circles through three points."""
    a = points[..., 0, :]
    p, q = points[..., 1, :] - a, points[..., 2, :] - a
    normal = torch.linalg.cross(p, q)
    twice = length(normal)
    flat = twice <= FLAT * length(p) * length(q)
    pp, qq = dot(p, p)[..., None], dot(q, q)[..., None]
    offset = (qq * torch.linalg.cross(normal, p) + pp * torch.linalg.cross(q, normal)) / (2 * twice * twice)[..., None]
    return _unless(flat, torch.cat([a + offset, normal / twice[..., None], length(offset)[..., None]], -1))


def _circle_distance(points: Tensor, shape: Tensor) -> Tensor:
    height = dot(points - shape[..., :3], shape[..., 3:6])
    beside = _line_distance(points, shape) - shape[..., 6]
    return (beside * beside + height * height).sqrt()


def _circle_linear(points: Tensor, shape: Tensor) -> list[Linear]:
    offset, normal = points - shape[..., :3], shape[..., 3:6]
    height = dot(offset, normal)
    away = offset - height[..., None] * normal
    far = length(away)
    outward = away / torch.where(far > 0, far, 1.0)[..., None]
    first, second = across(normal)
    u, v = dot(outward, first), dot(outward, second)
    none, one = torch.zeros_like(far), torch.ones_like(far)
    return [
        (far - shape[..., 6], [-u, -v, none, -height * u, -height * v, -one]),
        (height, [none, none, -one, dot(offset, first), dot(offset, second), none]),
    ]


def _circle_moved(shape: Tensor, step: Tensor) -> Tensor:
    first, second = across(shape[:, 3:6])
    normal = shape[:, 3:6]
    shift = (step[:, 0, None] * first + step[:, 1, None] * second) + step[:, 2, None] * normal
    normal = normal + (step[:, 3, None] * first + step[:, 4, None] * second)
    return torch.cat([shape[:, :3] + shift, normal / length(normal)[:, None], shape[:, 6:] + step[:, 5:]], 1)


SPHERE = Family("sphere", 4, _sphere_through, _sphere_distance, _sphere_linear, torch.add)
ORIENTED_SPHERE = Family("sphere", 2, _sphere_through, _sphere_distance, _sphere_linear, torch.add)
LINE = Family("line", 2, _line_through, _line_distance, _line_linear, _line_moved, has_radius=False)
CYLINDER = Family("cylinder", 2, _cylinder_through, _cylinder_distance, _cylinder_linear, _cylinder_moved)
CIRCLE = Family("circle", 3, _circle_through, _circle_distance, _circle_linear, _circle_moved)
