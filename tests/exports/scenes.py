"""Captures with all that any target asks for: color, mask, labels, a pose, and a robot's signals in one episode."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import torch

from pcdata.structures import DepthFrame, Episode
from pcdata.synthetic import BASE_FRAME, tabletop
from tests.exports.samples import Samples

_SMALL = 320  # the longest side that is rendered; larger images repeat its pixels


@cache
def scene(size: tuple[int, int], first_label: int) -> DepthFrame:
    """A table with objects in whole millimetres; of large images the mask keeps one pixel of each that was rendered."""
    times = -(-max(size) // _SMALL)
    small = tabletop(3, num_objects=4, size=(size[0] // times, size[1] // times), floor=False).frame
    depth, colors, labels = (
        one.repeat_interleave(times, dim=1).repeat_interleave(times, dim=2)
        for one in (small.depth, small.colors, small.labels)
    )
    mask = torch.zeros(1, *size, dtype=torch.bool)
    mask[:, times // 2 :: times, times // 2 :: times] = True
    return replace(
        small,
        depth=((depth.double() * 1000).round() * 0.001).float(),
        colors=colors,
        labels=torch.where(labels < 0, labels, labels + first_label),
        mask=mask,
        camera=small.camera.resized(size),
        provenance={"metres_per_unit": 0.001},
    )


class Episodes(Samples):
    """Two steps of an episode before one camera that stands still."""

    def __init__(self, size: tuple[int, int] = (240, 320), first_label: int = 1) -> None:
        super().__init__({f"s{number}": _step(scene(size, first_label), number) for number in range(2)})
        self.episodes = [Episode("e", 0, 2)]
        self.name = "scenes"

    def __len__(self) -> int:
        return len(self.ids)


def _step(frame: DepthFrame, number: int) -> DepthFrame:
    tcp = torch.tensor([[0.1, 0.05 * number, 0.3, 1.0, 0.0, 0.0, 0.0]])
    signals = {
        "state": (torch.arange(7.0)[None] + number, "invariant", None),
        "action": (torch.tensor([[0.02 * number, 0.1, 0.1, 1.0]]), "position + invariant 1", BASE_FRAME),
        "imagin_robot": (torch.zeros(1, 96, 7) + number, "invariant", None),
        "tcp": (tcp, "pose xyz_quat_wxyz", BASE_FRAME),
        "gripper": (torch.tensor([[0.02 + 0.01 * number]]), "invariant", None),
    }
    for name, said in signals.items():
        frame = frame.with_signal(name, *said)
    return replace(frame, sample_id=f"s{number}", capture_index=number)
