"""A recording of three cameras of which one moves, as an episode with signals and a gap."""

from __future__ import annotations

from dataclasses import replace

import torch

from pcdata import DepthFrame
from pcdata.structures import Episode, Signal
from pcdata.synthetic import tabletop

SIZE = (240, 320)
MOVED_FROM = 3
NUM_FRAMES = 6


def rig_frames() -> list[DepthFrame]:
    """Three cameras; from the fourth capture on the second stands 6 mm from where its pose says."""
    here = tabletop(0, num_views=3, noise="stereo", size=SIZE).frame.world_from_camera
    there = here.clone()
    there[1, :3, 3] += torch.tensor([0.0036, 0.0048, 0.0])
    scenes = [tabletop(0, num_views=3, noise="stereo", size=SIZE, world_from_camera=pose) for pose in (here, there)]
    frames = [scenes[number >= MOVED_FROM].render(seed_noise=number) for number in range(NUM_FRAMES)]
    names = {"cameras": ["left", "front", "right"]}
    return [
        replace(frame, world_from_camera=here, labels=None, colors=frame.colors ^ number, provenance=names)
        for number, frame in enumerate(frames)
    ]


class Recorded:
    """Frames in memory, as an episode with signals and a gap."""

    name = "recorded"

    def __init__(self, frames: list[DepthFrame]) -> None:
        self.frames = frames
        self.ids = [f"f{number}" for number in range(len(frames))]
        times = [0.1 * number + 3.0 * (number >= 4) for number in range(len(frames))]
        self.episodes = [Episode("pick", 0, len(frames), times)]

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> DepthFrame:
        return replace(self.frames[self.ids.index(sample_id)], sample_id=sample_id)

    def signals(self, sample_id: str) -> dict[str, Signal]:
        number = self.ids.index(sample_id)
        values = torch.tensor([[float(number), -float(number)]])
        texts = Signal(values=("pick it",), kind="text")
        return {"joints<b>": Signal(values=values, kind="invariant"), "task": texts}
