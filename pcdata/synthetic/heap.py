"""Objects on a table that touch each other: pushed together until they meet, and some on top of others."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Generator, Tensor

from pcdata.errors import ConfigError
from pcdata.geometry import rigid
from pcdata.rng import generator_for
from pcdata.synthetic.scene import PALETTE, TABLE_SIZE
from pcdata.synthetic.shapes import Box, Color, Cylinder, Shape, Sphere
from pcdata.synthetic.turned import Turned, bowl_profile, mug_profile

CONTACT = 0.0005  # metres: nearer than what any depth camera tells apart
_SAMPLES = 1500  # points of a surface that distances are taken from
_STACKED = 6  # every such object stands on another
_WITHIN = 0.8  # of the top of a box: what stands there
_AXIS_ALIGNED = 0.5  # of boxes: they touch face to face


def heap_objects(seed: int, num_objects: int) -> tuple[Shape, ...]:
    """Return objects 1..K: boxes, cans, balls, bowls and mugs, each pushed along the table until it meets another.

    Every sixth is put on top of a box where one is wide enough. More objects leave the first ones where they are.

    Raises:
        ConfigError: they do not fit on the table.
    """
    generator = generator_for(seed, 0, "synthetic/heap")
    placed: list[Shape] = []
    samples: list[Tensor] = []
    for label in range(1, num_objects + 1):
        shape, rise = _random_shape(label, PALETTE[label % len(PALETTE)], generator)
        surface = _surface(shape)
        start = None
        if label % _STACKED == 0:
            start = _on_top(placed, surface, rise)
        if start is None:
            start = _beside(placed, samples, shape, surface, rise, generator)
        pose = shape.base_from_object.clone()
        pose[:3, 3] = start
        placed.append(replace(shape, base_from_object=pose))
        samples.append(surface + start)
    return tuple(placed)


def _random_shape(label: int, color: Color, generator: Generator) -> tuple[Shape, float]:
    """Draw a shape about the origin, and how high its origin rests."""
    kind, a, b, c, yaw, flip = torch.rand(6, generator=generator, dtype=torch.float64, device="cpu").tolist()
    angle = 0.0 if flip < _AXIS_ALIGNED else 2 * math.pi * yaw
    turn = rigid.rotation_about_axis(
        torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device="cpu"),
        torch.tensor(angle, dtype=torch.float64, device="cpu"),
    )
    pose = rigid.from_rotation_translation(turn, torch.zeros(3, dtype=torch.float64, device="cpu"))
    if kind < 0.45:
        size = (0.06 + 0.10 * a, 0.05 + 0.07 * b, 0.03 + 0.12 * c)
        return Box(base_from_object=pose, size=size, label=label, color=color, pattern="band"), size[2] / 2
    if kind < 0.7:
        radius, height = 0.025 + 0.025 * a, 0.06 + 0.10 * b
        can = Cylinder(base_from_object=pose, radius=radius, height=height, label=label, color=color, pattern="band")
        return can, height / 2
    if kind < 0.8:
        radius = 0.03 + 0.02 * a
        return Sphere(base_from_object=pose, radius=radius, label=label, color=color, pattern="band"), radius
    if kind < 0.9:
        radius = 0.06 + 0.03 * a
        depth = (0.45 + 0.25 * b) * radius
        profile = bowl_profile(radius, depth, 0.005)
    else:
        radius, depth = 0.035 + 0.015 * a, 0.07 + 0.05 * b
        profile = mug_profile(radius, depth, 0.005)
    return Turned(base_from_object=pose, profile=profile, label=label, color=color, pattern="band"), depth / 2


def _surface(shape: Shape) -> Tensor:
    """Return points (n, 3) all over the outside of a shape about the origin."""
    number = torch.arange(_SAMPLES, dtype=torch.float64, device="cpu") + 0.5
    polar, around = (1 - 2 * number / _SAMPLES).arccos(), math.pi * (1 + 5**0.5) * number
    ways = torch.stack([around.cos() * polar.sin(), around.sin() * polar.sin(), polar.cos()], dim=1)
    found, _ = shape.intersect(2 * shape.bounding_radius * ways, -ways)
    hit = torch.isfinite(found)
    return ((2 * shape.bounding_radius - found)[:, None] * ways)[hit]


def _beside(
    placed: list[Shape], samples: list[Tensor], shape: Shape, surface: Tensor, rise: float, generator: Generator
) -> Tensor:
    """Push a shape from the edge of the table toward the middle until it meets another; return where it stands."""
    room = [edge / 2 - shape.bounding_radius - 0.02 for edge in TABLE_SIZE[:2]]
    for _ in range(200):
        angle, across = torch.rand(2, generator=generator, dtype=torch.float64, device="cpu").tolist()
        turned = 2 * math.pi * angle
        way = torch.tensor([math.cos(turned), math.sin(turned), 0.0], dtype=torch.float64, device="cpu")
        beside = (
            torch.tensor([-float(way[1]), float(way[0]), 0.0], dtype=torch.float64, device="cpu") * (across - 0.5) * 0.2
        )
        position = beside + torch.tensor([0.0, 0.0, rise], dtype=torch.float64, device="cpu")
        if not placed:
            return position
        at, nearest = 1.2, math.inf
        while at > 0 and nearest > CONTACT:
            nearest = _distance(placed, samples, shape, surface, position + at * way)
            at -= nearest - CONTACT / 2
        found = position + at * way
        if nearest <= CONTACT and all(abs(float(found[axis])) < room[axis] for axis in (0, 1)):
            return found
    raise ConfigError(f"tabletop: only {len(placed)} touching objects fit on the table; ask for fewer")


def _distance(placed: list[Shape], samples: list[Tensor], shape: Shape, surface: Tensor, position: Tensor) -> float:
    """Return how near a shape at a position comes to any that is placed."""
    own, least = surface + position, math.inf
    pose = shape.base_from_object.clone()
    pose[:3, 3] = position
    moved = replace(shape, base_from_object=pose)
    for other, theirs in zip(placed, samples):
        if float((other.center - position).norm()) - other.bounding_radius - shape.bounding_radius > least:
            continue
        least = min(least, float(other.signed_distance(own).min()), float(moved.signed_distance(theirs).min()))
    return least


def _on_top(placed: list[Shape], surface: Tensor, rise: float) -> Tensor | None:
    """Return where a shape stands on the first box that is wide enough and bears nothing; None where none is."""
    for box in placed:
        if not isinstance(box, Box):
            continue
        top = box.center + torch.tensor([0.0, 0.0, box.size[2] / 2], dtype=torch.float64, device="cpu")
        flat = float(surface[:, :2].norm(dim=1).max())
        bears = any(
            float((other.center - top)[:2].norm()) < min(box.size[:2]) / 2 and other.center[2] > top[2]
            for other in placed
        )
        if not bears and flat < _WITHIN * min(box.size[:2]) / 2:
            return top + torch.tensor([0.0, 0.0, rise], dtype=torch.float64, device="cpu")
    return None
