"""Samples small enough to export many times, and what lies in a folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from pcdata.geometry import rigid
from pcdata.rng import seeded
from pcdata.structures import Camera, DepthFrame, PointCloud
from pcdata.transforms import NormalizeUnitSphere


class Samples:
    """Samples by id; a callable is called when its sample is loaded."""

    kind = "test"

    def __init__(self, samples: dict) -> None:
        self.samples = samples
        self.ids = list(samples)
        self.loaded: list[str] = []

    def __repr__(self) -> str:
        return "Samples()"

    def load(self, sample_id: str):
        self.loaded.append(sample_id)
        value = self.samples[sample_id]
        return value() if callable(value) else value


def cloud(count: int = 40, seed: int = 0, **changes: object) -> PointCloud:
    """Points in the unit sphere with colors of 8 bits, normals and labels 0..3; metres in "base"."""
    generator = seeded(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    fields: dict = {
        "points": direction * torch.rand(count, 1, generator=generator),
        "frame_id": "base",
        "colors": torch.randint(256, (count, 3), generator=generator).float() / 255,
        "normals": direction,
        "labels": torch.arange(count) % 4,
    }
    return PointCloud(**(fields | changes))


def shape(count: int = 2048, seed: int = 0, **changes: object) -> PointCloud:
    """A cloud whose mean is the origin and whose farthest point is at 1."""
    made = NormalizeUnitSphere()(cloud(count, seed))
    return replace(made, **changes)


def frame(size: tuple[int, int] = (12, 16), seed: int = 0, **changes: object) -> DepthFrame:
    """A view in whole millimetres with one hole, color, a mask, labels -1, 1 and 2, and a pose."""
    generator = seeded(seed)
    height, width = size
    units: Tensor = torch.randint(400, 900, (1, height, width), generator=generator)
    units[0, 1, 2] = 0
    labels = torch.full((1, height, width), -1)
    labels[0, : height // 2, : width // 2] = 1
    labels[0, height // 2 :, width // 2 :] = 2
    rotation = rigid.rotation_from_quaternion(torch.randn(4, generator=generator, dtype=torch.float64))
    offset = torch.randn(3, generator=generator, dtype=torch.float64)
    camera = Camera.pinhole(fx=20.5, fy=21.25, cx=width / 2 - 0.75, cy=height / 2 + 0.5, size=size)
    fields: dict = {
        "depth": (units.double() * 0.001).float(),
        "camera": camera,
        "colors": torch.randint(256, (1, height, width, 3), generator=generator, dtype=torch.uint8),
        "mask": torch.rand(1, height, width, generator=generator) > 0.3,
        "labels": labels,
        "world_from_camera": rigid.from_rotation_translation(rotation, offset)[None],
        "frame_id": "table",
        "provenance": {"metres_per_unit": 0.001},
    }
    return DepthFrame(**(fields | changes))


def tree(folder: Path) -> dict[str, bytes | None]:
    """Everything below a folder, hidden names too."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}
