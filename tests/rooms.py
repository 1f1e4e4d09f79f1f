"""Rooms of boxes seen by a depth camera, of which every pixel's truth is known; z is up, metres."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from pcdata.rng import seeded
from pcdata.structures import Camera, DepthFrame, PointCloud
from pcdata.transforms import Deproject

SIZE, FOCAL = (150, 200), 180.0
Box = tuple[Sequence[float], Sequence[float]]  # lower and upper corner


def standing(x: float, y: float, size: Sequence[float], base: float = 0.0) -> Box:
    """A box of ``size`` whose bottom has its center at (x, y, base)."""
    length, width, height = size
    return (x - length / 2, y - width / 2, base), (x + length / 2, y + width / 2, base + height)


def seen_room(
    boxes: Sequence[Box],
    *,
    pitch: float = math.radians(40),
    distance: float = 1.0,
    roll: float = 0.0,
    noise: float = 0.0,
    seed: int = 0,
    scale: float = 1.0,
) -> PointCloud:
    """One organized cloud of :func:`room_frame`."""
    frame = room_frame(boxes, pitch=pitch, distance=distance, roll=roll, noise=noise, seed=seed, scale=scale)
    cloud = Deproject()(frame)
    assert isinstance(cloud, PointCloud)
    return cloud


def room_frame(
    boxes: Sequence[Box],
    *,
    pitch: float = math.radians(40),
    distance: float = 1.0,
    roll: float = 0.0,
    noise: float = 0.0,
    seed: int = 0,
    scale: float = 1.0,
) -> DepthFrame:
    """The depth image of what a camera sees that looks at the origin along +y, down by ``pitch`` radians.

    Labels are the numbers of the boxes; ``noise`` is the standard deviation of 1/z; ``roll`` tilts the whole room
    sideways; ``scale`` is the resolution, as a multiple of ``SIZE``.
    """
    size, focal = (round(SIZE[0] * scale), round(SIZE[1] * scale)), FOCAL * scale
    rows, columns = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in size), indexing="ij")
    ray = torch.stack(
        [(columns - (size[1] - 1) / 2) / focal, (rows - (size[0] - 1) / 2) / focal, torch.ones_like(rows)], -1
    ).reshape(-1, 3)
    down, level = math.sin(pitch), math.cos(pitch)
    axes = torch.tensor([[1, 0, 0], [0, -down, level], [0, -level, -down]], dtype=torch.float64)  # of the camera
    turned, aside = math.cos(roll), math.sin(roll)
    axes = torch.tensor([[turned, 0, aside], [0, 1, 0], [-aside, 0, turned]], dtype=torch.float64) @ axes
    way, start = ray @ axes.T, -axes @ torch.tensor([0.0, 0.0, distance], dtype=torch.float64)
    depth, label = torch.zeros(len(ray), dtype=torch.float64), torch.full((len(ray),), -1)
    for number, (lower, upper) in enumerate(boxes):
        corners = torch.tensor([lower, upper], dtype=torch.float64)
        slabs = (corners[:, None] - start) / way
        enters, leaves = slabs.amin(0).amax(1), slabs.amax(0).amin(1)
        hit = (enters < leaves) & (enters > 0) & ((depth == 0) | (enters < depth))
        depth, label = torch.where(hit, enters, depth), torch.where(hit, number, label)
    noisy = 1 / (1 / depth + noise * torch.randn(len(depth), generator=seeded(seed), dtype=torch.float64))
    depth = torch.where(depth > 0, noisy.clamp(0.05, 20), 0.0)
    camera = Camera.pinhole(fx=focal, fy=focal, cx=(size[1] - 1) / 2, cy=(size[0] - 1) / 2, size=size)
    return DepthFrame.from_numpy(depth.reshape(size).float().numpy(), camera, labels=label.reshape(size).numpy())
