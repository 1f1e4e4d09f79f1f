"""Where the cameras stand, what they look like inside, and by how much their reported poses are wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from pcdata.errors import ConfigError
from pcdata.geometry import rigid
from pcdata.rng import generator_for
from pcdata.structures import Camera

# Successive multiples of the golden angle spread evenly for any number of views, so adding a view moves no other.
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


def look_at(eye: Sequence[float], target: Sequence[float] = (0.0, 0.0, 0.0), *, roll: float = 0.0) -> Tensor:
    """Return world_from_camera (4, 4) float64 of a camera at ``eye`` that sees ``target`` in the middle of its image.

    The image is upright (world z points up in it), turned by ``roll`` radians about the view axis. Straight up or
    down, world y points up instead.
    """
    position = torch.tensor(eye, dtype=torch.float64, device="cpu")
    forward = torch.nn.functional.normalize(torch.tensor(target, dtype=torch.float64, device="cpu") - position, dim=0)
    up = torch.tensor(
        [0.0, 0.0, 1.0] if float(forward[:2].norm()) > 1e-6 else [0.0, 1.0, 0.0], dtype=torch.float64, device="cpu"
    )
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    upright = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    turn = rigid.rotation_about_axis(
        torch.tensor([0.0, 0.0, 1.0], dtype=torch.float32, device="cpu"),
        torch.tensor(roll, dtype=torch.float32, device="cpu"),
    )
    return rigid.from_rotation_translation(upright @ turn, position)


def place_cameras(seed: int, num_views: int, size: tuple[int, int]) -> tuple[Camera, Tensor]:
    """Return V cameras around and above the table, each a little different, and world_from_camera (V, 4, 4).

    View v depends on (seed, v) alone. The field of view is that of a common stereo depth camera, about 55 degrees
    wide; principal points are off center, as in every real camera.
    """
    height, width = size
    intrinsics, poses = [], []
    for view in range(num_views):
        draw = _uniform(generator_for(seed, view, "synthetic/camera"), 8)
        focal = 0.96 * width * (1.0 + 0.01 * draw[0])
        cx, cy = (width - 1) / 2 + 0.008 * width * draw[1], (height - 1) / 2 + 0.008 * height * draw[2]
        intrinsics.append([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
        azimuth = -0.5 * math.pi + view * GOLDEN_ANGLE + 0.25 * draw[3]
        elevation = math.radians(44.0 + 7.0 * draw[4])
        distance = 0.92 + 0.08 * draw[5]
        reach = distance * math.cos(elevation)
        eye = (reach * math.cos(azimuth), reach * math.sin(azimuth), distance * math.sin(elevation))
        poses.append(look_at(eye, (0.02 * draw[6], 0.02 * draw[7], 0.03), roll=math.radians(2.0) * draw[6]))
    return Camera(intrinsics=torch.tensor(intrinsics, dtype=torch.float64, device="cpu"), size=size), torch.stack(poses)


@dataclass(frozen=True, kw_only=True)
class Miscalibration:
    """A known error of the reported camera poses: a turn about, and a shift of, each camera's own center.

    The amounts are exact, their directions are drawn from the scene's seed. One number holds for every view, a
    sequence has one per view (0 = that view is right).
    """

    rotation_degrees: float | Sequence[float] = 0.0
    translation: float | Sequence[float] = 0.0  # metres

    def apply(self, world_from_camera: Tensor, seed: int) -> Tensor:
        """Return the poses (V, 4, 4) that a calibration with this error would report.

        Raises:
            ConfigError: a sequence whose length is not the number of views.
        """
        num_views = len(world_from_camera)
        angles = torch.deg2rad(self._per_view("rotation_degrees", num_views))
        shifts = self._per_view("translation", num_views)
        streams = [generator_for(seed, view, "synthetic/miscalibration") for view in range(num_views)]
        directions = torch.stack(
            [torch.randn(2, 3, generator=one, dtype=torch.float64, device="cpu") for one in streams]
        )
        axis, shift = torch.nn.functional.normalize(directions, dim=-1).unbind(1)
        error = rigid.from_rotation_translation(rigid.rotation_about_axis(axis, angles), shift * shifts[:, None])
        return world_from_camera @ error.to(world_from_camera.device)

    def _per_view(self, name: str, num_views: int) -> Tensor:
        value = getattr(self, name)
        amounts = list(value) if isinstance(value, Sequence) else [value] * num_views
        if len(amounts) != num_views:
            raise ConfigError(f"Miscalibration: {name} has {len(amounts)} amounts for {num_views} views; give one each")
        return torch.tensor(amounts, dtype=torch.float64, device="cpu")


def _uniform(generator: Generator, count: int) -> list[float]:
    """Draw numbers in [-1, 1)."""
    return (2.0 * torch.rand(count, generator=generator, dtype=torch.float64, device="cpu") - 1.0).tolist()
