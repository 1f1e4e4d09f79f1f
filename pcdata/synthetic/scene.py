"""A table, a floor and objects that stand on the one and do not touch each other."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Generator, Tensor

from pcdata.errors import ConfigError
from pcdata.geometry import rigid
from pcdata.rng import generator_for
from pcdata.synthetic.shapes import Box, Color, Cylinder, Shape, Sphere

TABLE_SIZE = (1.2, 0.8, 0.04)  # metres; the top is z = 0
FLOOR_Z = -0.75  # metres
FLOOR_SIZE = (16.0, 16.0, 0.1)  # metres; reaches past what the cameras see at their flattest
GAP = 0.012  # metres kept free between the circles around the objects' footprints

PALETTE: tuple[Color, ...] = (  # linear RGB
    (0.62, 0.05, 0.04), (0.03, 0.17, 0.52), (0.80, 0.42, 0.02), (0.04, 0.30, 0.12), (0.30, 0.07, 0.40),
    (0.01, 0.34, 0.38), (0.70, 0.13, 0.25), (0.24, 0.42, 0.04), (0.55, 0.19, 0.03), (0.11, 0.13, 0.21),
)  # fmt: skip


def make_table() -> Box:
    """Return the table, label 0: its top is the plane z = 0, centered on the origin."""
    return Box(base_from_object=_at(0.0, 0.0, -TABLE_SIZE[2] / 2), size=TABLE_SIZE, label=0, pattern="wood")


def make_floor() -> Box:
    """Return the floor, label -1: background."""
    center = _at(0.0, 0.0, FLOOR_Z - FLOOR_SIZE[2] / 2)
    return Box(base_from_object=center, size=FLOOR_SIZE, label=-1, color=(0.42, 0.44, 0.47), pattern="tiles")


def place_objects(seed: int, num_objects: int) -> tuple[Shape, ...]:
    """Return objects 1..K that rest on the table, clear of each other by at least ``GAP``.

    Drawn one after another: asking for more objects leaves the first ones where they were.

    Raises:
        ConfigError: they do not fit on the table.
    """
    generator = generator_for(seed, 0, "synthetic/objects")
    first_color = int(torch.randint(len(PALETTE), (), generator=generator, device="cpu"))
    placed: list[Shape] = []
    circles: list[tuple[float, float, float]] = []  # x, y, radius
    kinds: list[int] = []
    for label in range(1, num_objects + 1):
        # Each kind once before any comes again.
        kinds = kinds or torch.randperm(3, generator=generator, device="cpu").tolist()
        color = PALETTE[(first_color + label - 1) % len(PALETTE)]
        shape, footprint, rise = _random_shape(kinds.pop(), label, color, generator)
        x, y = _free_spot(circles, footprint, num_objects, generator)
        circles.append((x, y, footprint))
        pose = shape.base_from_object.clone()
        pose[:3, 3] = torch.tensor([x, y, rise], dtype=torch.float64, device="cpu")
        placed.append(replace(shape, base_from_object=pose))
    return tuple(placed)


def _random_shape(kind: int, label: int, color: Color, generator: Generator) -> tuple[Shape, float, float]:
    """Draw a shape about the origin; also the radius of its footprint and how high its center rests."""
    a, b, c, yaw, flip = torch.rand(5, generator=generator, dtype=torch.float64, device="cpu").tolist()
    turned = _turned((0.0, 0.0, 1.0), 2.0 * math.pi * yaw)
    if kind == 0:
        size = (0.06 + 0.08 * a, 0.05 + 0.06 * b, 0.04 + 0.10 * c)
        box = Box(base_from_object=turned, size=size, label=label, color=color, pattern="band")
        return box, math.hypot(size[0], size[1]) / 2, size[2] / 2
    if kind == 1:
        radius, height = 0.025 + 0.02 * a, 0.07 + 0.08 * b
        lying = flip < 0.3
        pose = turned @ _turned((1.0, 0.0, 0.0), math.pi / 2) if lying else turned
        can = Cylinder(base_from_object=pose, radius=radius, height=height, label=label, color=color, pattern="band")
        return (can, can.bounding_radius, radius) if lying else (can, radius, height / 2)
    radius = 0.028 + 0.022 * a
    tilted = turned @ _turned((1.0, 0.0, 0.0), math.pi * flip)  # seen only in the ball's stripe
    ball = Sphere(base_from_object=tilted, radius=radius, label=label, color=color, pattern="band")
    return ball, radius, radius


def _free_spot(
    circles: list[tuple[float, float, float]], radius: float, num_objects: int, generator: Generator
) -> tuple[float, float]:
    """Draw positions, at first near the middle of the table, until the circle is free and wholly on the table."""
    room_x, room_y = TABLE_SIZE[0] / 2 - radius - GAP, TABLE_SIZE[1] / 2 - radius - GAP
    for attempt in range(2000):
        spread = min(1.0, 0.45 + attempt / 200)
        x, y = ((2.0 * torch.rand(2, generator=generator, dtype=torch.float64, device="cpu") - 1.0) * spread).tolist()
        x, y = x * room_x, y * room_y
        if all(math.hypot(x - other_x, y - other_y) >= radius + other + GAP for other_x, other_y, other in circles):
            return x, y
    raise ConfigError(
        f"tabletop: only {len(circles)} of num_objects={num_objects} fit on the {TABLE_SIZE[0]} x {TABLE_SIZE[1]} m "
        "table; ask for fewer"
    )


def _at(x: float, y: float, z: float) -> Tensor:
    position = torch.tensor([x, y, z], dtype=torch.float64, device="cpu")
    return rigid.from_rotation_translation(torch.eye(3, dtype=torch.float64, device="cpu"), position)


def _turned(axis: tuple[float, float, float], angle: float) -> Tensor:
    rotation = rigid.rotation_about_axis(
        torch.tensor(axis, dtype=torch.float32, device="cpu"), torch.tensor(angle, dtype=torch.float64, device="cpu")
    )
    return rigid.from_rotation_translation(rotation, torch.zeros(3, dtype=torch.float64, device="cpu"))
