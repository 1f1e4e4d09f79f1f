"""Small clouds and captures made from fixed seeds, and folders to write to."""

from __future__ import annotations

import functools
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from digest_names import NORMALIZED, Camera, DepthFrame, Kind, PointCloud, tabletop
from torch import Tensor

COUNTS = (120, 150)


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@functools.cache
def _scratch() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="pcdata-digests-")


def scratch(name: str) -> Path:
    """An empty folder of a fixed name, in a place of its own that goes at the end."""
    folder = Path(_scratch().name) / name
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    return folder


# -- made up -----------------------------------------------------------------------------------------------------------


def rotation(seed: int) -> Tensor:
    """A (3, 3) float64 rotation."""
    w, x, y, z = torch.nn.functional.normalize(torch.randn(4, generator=seeded(seed), dtype=torch.float64), dim=0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.tensor([[float(value) for value in row] for row in rows], dtype=torch.float64)


def pose(seed: int, offset: Sequence[float] = (0.0, 0.0, 0.8)) -> Tensor:
    """A (4, 4) float64 rigid pose."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = rotation(seed)
    matrix[:3, 3] = torch.tensor(offset, dtype=torch.float64)
    return matrix


def poses(count: int, seed: int = 0) -> Tensor:
    return torch.stack([pose(seed + b, (0.02 * b, 0.05, 0.8)) for b in range(count)])


def scene_points(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """(N, 3) points above a table z = 0 and their labels: half on the table (-1), the rest in two balls (0, 1)."""
    generator = seeded(seed)
    labels = torch.arange(count) % 4
    labels = torch.where(labels < 2, -1, labels - 2)
    table = torch.cat([torch.rand(count, 2, generator=generator) * 0.4 - 0.2, torch.zeros(count, 1)], dim=1)
    balls = torch.tensor([[-0.10, 0.0, 0.05], [0.10, 0.05, 0.05]])
    inside = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    ball = balls[labels.clamp(min=0)] + 0.02 * inside * torch.rand(count, 1, generator=generator)
    return torch.where(labels[:, None] < 0, table, ball), labels


def camera_cloud(counts: Sequence[int] = COUNTS, seed: int = 0) -> Any:
    """A batch in the frames of its cameras with a field of every kind; "base" is the table's frame."""
    base_from_camera = poses(len(counts), seed)
    parts = [scene_points(count, seed + b) for b, count in enumerate(counts)]
    moved = [
        ((points.double() - pose[:3, 3]) @ pose[:3, :3]).float()
        for (points, _), pose in zip(parts, base_from_camera, strict=True)
    ]
    points, labels = torch.cat(moved), torch.cat([part[1] for part in parts])
    total, generator = len(points), seeded(seed + 100)
    normals = torch.nn.functional.normalize(torch.randn(total, 3, generator=generator), dim=1)
    colors = torch.rand(total, 3, generator=generator)
    extra = {
        "weight": (Kind.INVARIANT, torch.rand(total, generator=generator)),
        "anchor": (Kind.POSITION, points.clone()),
        "heading": (Kind.DIRECTION, normals.clone()),
        "confidence": (Kind.MINIMUM, torch.randint(4, (total,), generator=generator, dtype=torch.uint8)),
    }
    return PointCloud(
        points=points,
        ptr=torch.tensor([0, *counts]).cumsum(0),
        frame_id="camera",
        colors=colors,
        normals=normals,
        labels=labels,
        source_index=1000 + 3 * torch.arange(total),
        extra={name: values for name, (_, values) in extra.items()},
        kinds={name: kind for name, (kind, _) in extra.items()},
        viewpoint=torch.zeros(len(counts), 3),
        frames={"camera": torch.eye(4, dtype=torch.float64).repeat(len(counts), 1, 1), "base": base_from_camera},
        meta=[{"sample_id": f"sample-{b}", "number": b} for b in range(len(counts))],
    )


def base_cloud(counts: Sequence[int] = COUNTS, seed: int = 0) -> Any:
    """The same batch in the frame "base"."""
    cloud = camera_cloud(counts, seed)
    return cloud.transformed(cloud.frames["base"], frame_id="base")


def normalized_cloud(counts: Sequence[int] = COUNTS, seed: int = 0) -> Any:
    """The same batch in a unit that is half a metre."""
    twice = torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0])).repeat(len(counts), 1, 1)
    return base_cloud(counts, seed).transformed(twice, unit=NORMALIZED)


def small_frame(counts: Sequence[int] = COUNTS, seed: int = 0) -> Any:
    """A capture of 12 x 16 pixels whose view v has ``counts[v]`` readings at random pixels, with every image."""
    size, views, generator = (12, 16), len(counts), seeded(seed)
    depth = torch.zeros(views, size[0] * size[1])
    for view, count in enumerate(counts):
        chosen = torch.randperm(depth.shape[1], generator=generator)[:count]
        depth[view, chosen] = 0.5 + 0.5 * torch.rand(len(chosen), generator=generator)
    camera = Camera.pinhole(fx=20.0, fy=21.0, cx=7.3, cy=5.8, size=size)
    return DepthFrame(
        depth=depth.reshape(views, *size),
        camera=replace(camera, intrinsics=camera.intrinsics.repeat(views, 1, 1)),
        colors=torch.randint(256, (views, *size, 3), generator=generator, dtype=torch.uint8),
        labels=torch.randint(-1, 4, (views, *size), generator=generator),
        confidence=torch.randint(4, (views, *size), generator=generator, dtype=torch.uint8),
        mask=torch.rand(views, *size, generator=generator) < 0.7,
        world_from_camera=poses(views, seed),
        frame_id="base",
        capture_index=3,
        sample_id="capture-3",
        provenance={"sensor": "made up"},
    )


@functools.cache
def rendered(num_views: int = 1, seed: int = 0, size: tuple[int, int] = (60, 80), noise: str | None = None) -> Any:
    """A rendered table with three objects."""
    return tabletop(seed, num_objects=3, num_views=num_views, size=size, noise=noise, floor=False).frame


def with_confidence(frame: Any) -> Any:
    return replace(frame, confidence=3 - (frame.depth == 0).to(torch.uint8))


def with_lens(frame: Any) -> Any:
    """The capture as if its images were seen through a lens."""
    lens = torch.tensor([[0.05, -0.02, 0.001, -0.002, 0.01]], dtype=torch.float64)
    camera = replace(frame.camera, distortion=lens.repeat(len(frame.depth), 1))
    return replace(frame, camera=camera)


class Samples:
    """Captures or clouds in memory as a source."""

    kind = "memory"
    name = "memory"

    def __init__(self, samples: Mapping[str, Any]) -> None:
        self._samples = dict(samples)
        self.ids = list(samples)

    def load(self, sample_id: str) -> Any:
        return self._samples[sample_id]
