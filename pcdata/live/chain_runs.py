"""The steps of a live chain on frame after frame: those that a GPU repeats, the others in passes, each timed."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from pcdata.errors import ConfigError
from pcdata.live.fixed_frames import FixedFrames, Seen
from pcdata.live.latency import Histogram, Latency
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms import Compose
from pcdata.transforms.found_planes import guessing_planes


class ChainRuns:
    """Runs a chain on the frames of one camera; see :class:`pcdata.live.LivePipeline` for what it is given.

    It runs once on the first frame, so what is wrong with the chain is raised when this is made.
    """

    def __init__(self, chain: Compose, like: DepthFrame, *, seed: int | None, warm_planes: bool) -> None:
        """Check the chain, and capture the steps that can be repeated.

        Raises:
            ConfigError: the chain gives no clouds, or is random and there is no seed.
            PcdataError: the chain refuses the first frame.
        """
        _check(chain, seed)
        self._chain, self._seed, self._warm_planes = chain, seed, warm_planes
        self._names = [type(step).__name__ for step in chain.steps]
        self._pass_names: dict[tuple[int, int], str] = {}
        self._planes: Sequence[Mapping[str, Any]] = ()  # of the last cloud
        self._fixed: FixedFrames | None = None
        self.reset_stats()
        if self.run(like) is None:
            raise ConfigError("LivePipeline: the chain gives no clouds; put Deproject into it")
        self._fixed = FixedFrames.of(list(chain.steps), like)
        self._rest = chain.steps_from(0 if self._fixed is None else len(self._fixed.steps))
        self.reset_stats()

    def __len__(self) -> int:
        return len(self._names)

    @property
    def captured(self) -> tuple[str, ...]:
        """The steps from the first on that are repeated as they were captured."""
        return () if self._fixed is None else tuple(self._names[: len(self._fixed.steps)])

    def look(self, frame: DepthFrame) -> Seen | None:
        """Run the captured steps on a frame; None where there are none."""
        if self._fixed is None:
            return None
        self._since = time.perf_counter()
        return self._fixed.look(frame)

    def run(self, frame: DepthFrame, seen: Seen | None = None) -> PointCloud:
        """Run the chain, behind what was captured, and count how long each pass took."""
        seed = self._seed
        generator = None if seed is None else torch.Generator("cpu").manual_seed(seed)
        chain, done, since = self._chain, 0, time.perf_counter()
        data: DepthFrame | PointCloud = frame

        def after(steps: range, _: Any) -> None:
            nonlocal since
            now = time.perf_counter()
            self.count(self._pass_name(done + steps.start, done + steps.stop), now - since)
            since = now

        with torch.set_grad_enabled(False), guessing_planes(self._planes):
            if self._fixed is not None:
                if seen is None:
                    self._since = since
                    seen = self._fixed.look(frame)
                begun = None if seen is None else self._fixed.cloud(frame, seen)
                if begun is not None:
                    chain, data, since = self._rest, begun, self._since
                    after(range(len(self._fixed.steps)), data)
                    done = len(self._fixed.steps)
            cloud: PointCloud = chain.run_in_passes(data, generator=generator, after=after)
        if self._warm_planes and "RemovePlane" not in self.captured:  # which searches anew, and tells later
            self._planes = cloud.meta[0].get("planes", ())
        return cloud

    def _pass_name(self, start: int, stop: int) -> str:
        name = self._pass_names.get((start, stop))
        if name is None:
            name = self._pass_names[start, stop] = " + ".join(self._names[start:stop])
        return name

    def count(self, name: str, seconds: float) -> None:
        """Count how long something took, by its name."""
        taken = self._passes.get(name)
        if taken is None:
            taken = self._passes[name] = Histogram()
        taken.add(seconds)

    def latency(self) -> dict[str, Latency]:
        """Return how long each pass took, and what else was counted."""
        return {name: histogram.summary() for name, histogram in self._passes.items()}

    def reset_stats(self) -> None:
        """Begin to count anew."""
        self._passes: dict[str, Histogram] = {}

    def forget(self) -> None:
        """Forget the frames before."""
        self._planes = ()
        if self._fixed is not None:
            self._fixed.forget()


def _check(chain: Compose, seed: int | None) -> None:
    if not issubclass(chain.takes, DepthFrame) or not issubclass(chain.gives, PointCloud):
        raise ConfigError(
            f"LivePipeline: the chain must lead from captures to clouds, but takes a {chain.takes.__name__} "
            f"and gives a {chain.gives.__name__}; Deproject makes one of the other"
        )
    if chain.is_random and seed is None:
        raise ConfigError(
            "LivePipeline: the chain has random steps, which are for training; give chain.split()[0], the steps "
            "before the first of them, or a seed to draw with for every frame"
        )
