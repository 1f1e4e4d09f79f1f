"""The beginning of a chain on a GPU, captured once and repeated for every frame: the host waits once, for the result.

Steps that can (:meth:`pcdata.transforms.base.Transform.fixed_work`) work in arrays with room for every pixel, and what
drops rows changes a number on the device. So each frame starts the same kernels with the same arguments: one CUDA
graph. Whatever a step would refuse is told by a flag, and such a frame is left to the chain itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.asked_later import asking_later
from pcdata.contracts.dispatch import roomy_body
from pcdata.contracts.known import FINITE, note
from pcdata.contracts.on_host import uploaded
from pcdata.errors import PcdataError
from pcdata.functional.depth.deproject import Deprojected
from pcdata.functional.fixed_rows import FixedRows
from pcdata.functional.image_grid import pixels_rise
from pcdata.kernels.cuda.launching import launcher_of
from pcdata.structures import DepthFrame, PointCloud
from pcdata.structures.read_later import Metas
from pcdata.structures.structure import derived
from pcdata.transforms import Deproject
from pcdata.transforms.base import Transform

_IMAGES = ("depth", "mask", "confidence")  # that steps on captures look at


@dataclass(frozen=True)
class Seen:
    """What the device says of a frame."""

    least: float  # depth
    largest: float
    is_same: bool  # as the frame before
    bounds: list[list[int]]  # row pointers behind every step that gives clouds
    told: list[list[float]]  # what else each of these had to say
    is_usual: bool  # else the chain itself is to be asked


class FixedFrames:
    """Runs the beginning of a chain on frames like the first one.

    Not safe for two threads at once: all frames go through the same memory.
    """

    def __init__(self, steps: Sequence[Transform], works: Sequence[Callable[[Any], Any]], like: DepthFrame) -> None:
        self.steps = steps
        self._works = works
        held = {name: value.detach().clone() for name in _IMAGES if (value := getattr(like, name)) is not None}
        self._frame = derived(like, **held)
        self._last = torch.full_like(self._frame.depth, torch.nan)
        (self._numbers, self._stages), self._repeat = launcher_of(like.depth).captured(self._work)
        self.forget()

    @classmethod
    def of(cls, steps: Sequence[Transform], like: DepthFrame) -> FixedFrames | None:
        """Prepare the steps from the first one on that have fixed shapes; None where that leads to no cloud."""
        if like.device.type == "cpu" or roomy_body("move_kept", like.device) is None:
            return None
        data: Any = like
        works = []
        # What is kept is written to again, in whatever mode of torch a frame comes.
        with torch.inference_mode(False), torch.no_grad(), asking_later():
            for step in steps:
                # What a subclass of somebody's does is its own; and hooks want to see what comes and goes.
                is_ours = type(step).__module__.startswith("pcdata.")
                work = (
                    step.fixed_work(data) if is_ours and not (step._forward_hooks or step._forward_pre_hooks) else None
                )
                if work is None:
                    break
                data = work(data)
                works.append(work)
            return cls(steps[: len(works)], works, like) if isinstance(data, FixedRows) else None

    def forget(self) -> None:
        """Forget the frame before."""
        self._last.fill_(torch.nan)

    def _work(self) -> tuple[Tensor, list[Any]]:
        """Look at the frame that is held and run the steps; return what the host wants to know, and what each left."""
        depth = self._frame.depth
        with torch.no_grad(), asking_later() as put_off:
            least, largest = depth.aminmax()
            is_same = (depth == self._last).all()
            is_good = (least >= 0) & (largest > 0) & largest.isfinite()
            self._last.copy_(torch.where(is_good, depth, self._last))
            data: Any = self._frame
            stages = []
            for work in self._works:
                data = work(data)
                stages.append(data)
            asks = torch.cat(put_off.flags).ne(0).any()
            self._constants = put_off.constants  # whose addresses are taken down
            told = [one.double().reshape(1) for one in (least, largest, is_same, asks)]
            for stage in stages:
                if isinstance(stage, FixedRows):  # row pointers are below 2^53, so a double says them
                    told += [stage.ptr.double(), *([] if stage.told is None else [stage.told.flatten()])]
            return torch.cat(told), stages

    def look(self, frame: DepthFrame) -> Seen | None:
        """Run the steps on a frame and wait for what the device says; None if the frame has other images."""
        held = {name: getattr(self._frame, name) for name in _IMAGES}
        given = {name: getattr(frame, name) for name in _IMAGES}
        if any((held[name] is None) != (given[name] is None) for name in _IMAGES):
            return None
        for name, value in given.items():
            if value is not None:
                held[name].copy_(value.detach(), non_blocking=True)
        self._repeat()
        least, largest, is_same, asks, *numbers = self._numbers.tolist()
        bounds, told = [], []
        for stage in self._stages:
            if isinstance(stage, FixedRows):
                size = len(stage.ptr)
                bounds.append([int(bound) for bound in numbers[:size]])
                stop = size + (0 if stage.told is None else stage.told.numel())
                told.append(numbers[size:stop])
                del numbers[:stop]
        is_usual = not asks and all(stop > start for one in bounds for start, stop in pairwise(one))
        return Seen(least, largest, bool(is_same), bounds, told, is_usual)

    def cloud(self, frame: DepthFrame, seen: Seen) -> PointCloud | None:
        """Return the cloud of the frame that was looked at, which is the caller's; None where a step refuses it."""
        if not seen.is_usual:
            return None
        try:
            return self._cloud(frame, seen.bounds, seen.told)
        except (PcdataError, Warning):  # a warning may be an error to the caller
            return None  # the chain itself says why

    def _cloud(self, frame: DepthFrame, bounds: list[list[int]], told: list[list[float]]) -> PointCloud:
        kinds = [isinstance(stage, FixedRows) for stage in self._stages]
        start = kinds.index(True)  # the deprojection
        for step in self.steps[:start]:
            frame = step.recorded(frame, frame, {})
        if start:
            frame = derived(frame, confidence=self._stages[start - 1].confidence)
        deproject, rows = self.steps[start], self._stages[-1]
        assert isinstance(deproject, Deproject)
        ptrs = [uploaded(torch.tensor(one, dtype=torch.int64, device="cpu"), frame.device) for one in bounds]
        counts = [[stop - start for start, stop in pairwise(one)] for one in bounds]
        count = bounds[-1][-1]
        source_index = rows.source_index[:count].clone()
        images = deproject.images_of(frame)
        colors = None if frame.colors is None else frame.colors.reshape(-1, 3)[source_index].float().div_(255)
        fields = {name: image.flatten(0, 2)[source_index] for name, image in images.items()}
        points = rows.points[:count].clone()
        note(FINITE, points)  # a flag would say so
        cloud = deproject.cloud_of(frame, Deprojected(points, ptrs[-1], source_index, colors, fields))
        if rows.counts is not None:  # they were picked, and lie on no image any more
            cloud = derived(cloud, layout=None)
        elif frame.num_views == 1:
            note(pixels_rise(frame.size), source_index, ptrs[-1])
        if rows.normals is not None:
            cloud = derived(cloud, normals=rows.normals.clone())
        cloud = deproject.recorded_counts(cloud, None, counts[0], {})
        for place, step in enumerate(self.steps[start + 1 :]):
            before, after = counts[place : place + 2]
            earlier, stage = self._stages[start + place : start + place + 2]
            given, params = derived(cloud, ptr=ptrs[place]), {}
            if stage.chosen is not earlier.chosen:
                room = bounds[place][-1] if stage.chosen.dtype is torch.bool else len(stage.chosen)
                params = {"index": stage.chosen[:room].clone(), "ptr": ptrs[place + 1]}
            if stage.told is not None:
                given = derived(given, points=earlier.points[: bounds[place][-1]].clone())
                numbers = torch.tensor(told[place + 1], dtype=torch.float64, device="cpu").view_as(stage.told)
                params, facts = step.fixed_facts(given, params, numbers)
                held = vars(cloud)["meta"]
                cloud = derived(cloud, meta=(held if isinstance(held, Metas) else Metas([held])).then(facts))
            rows_told = step.told_rows(given, params)
            cloud = step.recorded_counts(cloud, before, after, params, rows=rows_told)
        return cloud

    def __repr__(self) -> str:
        room = math.prod(self._frame.depth.shape)
        return f"FixedFrames({', '.join(type(step).__name__ for step in self.steps)}; {room} rows)"
