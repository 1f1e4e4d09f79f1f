"""Captures in memory that hold all that a capture can hold, for whatever writes captures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from pcdata.rng import seeded
from pcdata.structures import Camera, DepthFrame, Episode, Signal
from tests.factories import base_from_camera

UNIT = 0.0001  # metres, as a D405 counts


@dataclass
class MadeCaptures:
    """Frames by id, with their episodes."""

    frames: dict[str, DepthFrame]
    episodes: list[Episode] = field(default_factory=list)
    name: str = "made"

    @property
    def ids(self) -> list[str]:
        return list(self.frames)

    def __len__(self) -> int:
        return len(self.frames)

    def load(self, sample_id: str) -> DepthFrame:
        return self.frames[sample_id]

    def signals(self, sample_id: str) -> Any:
        return self.frames[sample_id].recorded_signals


def made_frame(number: int = 0, views: int = 1, **changed: Any) -> DepthFrame:
    """A capture of 12 x 16 pixels with everything that it can have; its depth is whole tenths of a millimetre."""
    size, generator = (12, 16), seeded(number)
    units = torch.randint(2000, 9000, (views, *size), generator=generator)
    units[torch.rand(views, *size, generator=generator) < 0.2] = 0
    lens = torch.tensor([[0.1, -0.02, 0.001, -0.002, 0.01, 0.02, 0.0, 0.003]], dtype=torch.float64)
    camera = Camera.pinhole(fx=20.3, fy=21.7, cx=7.3, cy=5.8, size=size)
    return DepthFrame(
        **{
            "depth": (units.double() * UNIT).float(),
            "camera": Camera(
                intrinsics=camera.intrinsics.repeat(views, 1, 1) + torch.arange(views).reshape(-1, 1, 1) * _FOCAL,
                size=size,
                distortion=lens.repeat(views, 1),
            ),
            "colors": torch.randint(256, (views, *size, 3), generator=generator, dtype=torch.uint8),
            "labels": torch.randint(-1, 4, (views, *size), generator=generator),
            "confidence": torch.randint(4, (views, *size), generator=generator, dtype=torch.uint8),
            "mask": torch.rand(views, *size, generator=generator) < 0.7,
            "world_from_camera": base_from_camera(views, seed=number),
            "frame_id": "base",
            "capture_index": number,
            "sample_id": f"{number:03d}",
            "provenance": {"metres_per_unit": UNIT, "sensor_name": "made up"},
            "recorded_signals": made_signals(number),
            **changed,
        }
    )


def made_signals(number: int) -> dict[str, Signal]:
    """Signals of every kind of value: joints, a pose, an action with a horizon, a count, a text."""
    generator = seeded(100 + number)
    pose = base_from_camera(1, seed=number)
    return {
        "joints": Signal(torch.randn(1, 7, generator=generator, dtype=torch.float64), "invariant"),
        "eef": Signal(pose, "pose matrix", "base"),
        "action": Signal(torch.randn(1, 4, generator=generator), "position + invariant 1", "base"),
        "plan": Signal(torch.randn(1, 3, 3, generator=generator), "position", "base"),
        "count": Signal(torch.tensor([number]), "invariant"),
        "task": Signal(("put the cube on the disc: µ",), "text"),
    }


def made_captures(count: int = 5, views: int = 1, **changed: Any) -> MadeCaptures:
    """Some captures in two episodes, of 2 and of the rest but one, which belongs to none."""
    frames = {f"{number:03d}": made_frame(number, views, **changed) for number in range(count)}
    episodes = [
        Episode("pick 0", 0, 2, [0.0, 0.1], {"task": "pick", "success": True}),
        Episode("pick 1", 2, count - 3, [0.05 * step for step in range(count - 3)], {"task": "place", "tries": 2}),
    ]
    return MadeCaptures(frames, episodes)


def cut_to_episodes(made: MadeCaptures) -> MadeCaptures:
    """The captures that belong to an episode."""
    inside = {place for one in made.episodes for place in one.steps}
    kept: Sequence[str] = [name for place, name in enumerate(made.ids) if place in inside]
    return MadeCaptures({name: made.frames[name] for name in kept}, made.episodes)


_FOCAL = torch.tensor([[1.5, 0.0, 0.0], [0.0, 1.5, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
