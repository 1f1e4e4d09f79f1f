"""Compose and RandomApply: transforms made of transforms."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from torch import Generator, nn

from pcdata.errors import ConfigError, PcdataWarning
from pcdata.rng import Streams, seeded
from pcdata.structures import METRE, NORMALIZED, PointCloud
from pcdata.transforms.base import Data, GeneratorLike, Params, Transform, num_clouds, unit_advice
from pcdata.transforms.capture import find_capture, run_capture
from pcdata.transforms.fields import Fraction


class PipelineOrderWarning(PcdataWarning):
    """A pipeline is valid but its order costs time or quality."""


class Compose(Transform):
    """Run steps one after another; check at construction that neighbours fit.

    Raises:
        ConfigError: a step cannot take what the step before it gives (capture or cloud, frame, unit).
    """

    steps: Sequence[Transform]

    def __init__(self, steps: Sequence[Transform]) -> None:
        self.steps = list(steps)
        self.__post_init__()

    def check_fields(self) -> None:
        """Check the chain and make the steps submodules."""
        flat = list(_flatten(self.steps))
        _check_chain(flat)
        _warn_statistics_before_crop(flat)
        steps = self.__dict__.pop("steps")
        self._capture = find_capture(steps)
        self.steps = nn.ModuleList(steps)  # type: ignore[assignment]
        self.is_random = any(step.is_random for step in steps)  # type: ignore[misc]
        self.keeps_clouds = all(step.keeps_clouds for step in steps)  # type: ignore[misc]
        self.takes = steps[0].takes if steps else PointCloud  # type: ignore[misc]
        self.gives = steps[-1].gives if steps else PointCloud  # type: ignore[misc]

    def frame_after(self, frame: str | None) -> str | None:
        """The frame after the last step."""
        for step in self.steps:
            frame = step.frame_after(frame)
        return frame

    def unit_given(self) -> str | None:
        """The unit that the last step to change it gives."""
        units = [step.unit_given() for step in self.steps]
        return next((unit for unit in reversed(units) if unit is not None), None)

    def forward(self, data: Data, *, generator: GeneratorLike | None = None) -> Any:
        """Run every step; the steps record themselves, the chain adds nothing."""
        result = data
        for _, result in self._run(data, generator, self._capture):  # noqa: B007 - the last one counts
            pass
        return result

    def step_through(self, data: Data, *, generator: GeneratorLike | None = None) -> Iterator[tuple[Transform, Any]]:
        """Yield ``(step, data)`` after every step, for looking inside."""
        return self._run(data, generator, None)

    def _run(
        self, data: Data, generator: GeneratorLike | None, capture: slice | None
    ) -> Iterator[tuple[Transform, Any]]:
        """Yield after every step, with those of ``capture`` run as one where that is possible."""
        if self.is_random:
            generator = self._generator(generator)
            if not isinstance(generator, Generator):
                generator = Streams.of(generator, num_clouds(data)).generators
        steps = list(self.steps)
        position = 0
        while position < len(steps):
            step = steps[position]
            if capture is not None and position == capture.start:
                cloud = run_capture(steps[capture], data)
                if cloud is not None:
                    data, position = cloud, capture.stop
                    yield steps[position - 1], data
                    continue
            if step.is_random:
                # One stream per cloud, split off once: random steps in a row draw from the same streams, so that
                # running only the random suffix on a cached prefix gives the same draws.
                generator = _streams_for(generator, num_clouds(data))
            data = step(data, generator=generator if step.is_random else None)
            position += 1
            yield step, data

    def split(self) -> tuple[Compose, Compose]:
        """Return the longest deterministic prefix, which a cache may hold, and the rest; a chain within is opened."""
        steps = list(opened(self.steps))
        first = next((i for i, step in enumerate(steps) if step.is_random), len(steps))
        with order_checked_before():
            return Compose(steps[:first]), Compose(steps[first:])

    def to_config_list(self) -> list[dict[str, Any]]:
        """Return the steps as a list of ``{name: fields}``."""
        return [step.to_config() for step in self.steps]

    def __len__(self) -> int:
        return len(self.steps)

    def __repr__(self) -> str:
        return f"Compose([{', '.join(map(repr, self.steps))}])"


class RandomApply(Transform):
    """Apply a transform to each cloud with a probability.

    Args:
        step: what is applied, from clouds to clouds.
    """

    is_random = True

    step: Transform
    probability: Fraction = 0.5

    def check_fields(self) -> None:
        """Require a transform from clouds to clouds."""
        if not (self.step.takes is PointCloud and self.step.gives is PointCloud):
            raise ConfigError(f"RandomApply: {type(self.step).__name__} does not turn clouds into clouds")
        self.keeps_clouds = self.step.keeps_clouds  # type: ignore[misc]

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw, per cloud, whether it is chosen and the seed of what happens to it then."""
        chosen = streams.uniform(0.0, 1.0) < self.probability
        return {"chosen": chosen, "seed": streams.seeds()}

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Run the inner transform on the chosen clouds and pack all again."""
        clouds = data.unbatch()
        for b, (chosen, seed) in enumerate(zip(params["chosen"].tolist(), params["seed"].tolist(), strict=True)):
            if chosen:
                clouds[b] = self.step(clouds[b], generator=[seeded(seed)])
        return PointCloud.cat(clouds)


@contextmanager
def order_checked_before() -> Iterator[None]:
    """Compose steps again whose order was warned about when they were first composed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PipelineOrderWarning)
        yield


def _streams_for(generator: GeneratorLike | None, count: int) -> Sequence[Generator]:
    assert generator is not None
    if isinstance(generator, Generator):
        return Streams.of(generator, count).generators
    if len(generator) == count:
        return generator
    # Views were merged or split: the first stream carries on.
    return generator[:1] if count == 1 else Streams.of(generator[0], count).generators


def opened(steps: Sequence[Transform]) -> Iterator[Transform]:
    """Yield the steps with those of a chain within in its place: a chain adds nothing to its steps."""
    for step in steps:
        if isinstance(step, Compose):
            yield from opened(step.steps)
        else:
            yield step


def _flatten(steps: Sequence[Transform]) -> Iterator[Transform]:
    for step in opened(steps):
        if isinstance(step, RandomApply):
            yield from _flatten([step.step])
        else:
            yield step


def _check_chain(steps: Sequence[Transform]) -> None:
    frame: str | None = None
    unit = METRE if steps and steps[0].takes is not PointCloud else None  # None: that of whatever comes in
    for position, (before, after) in enumerate(itertools.pairwise(steps), start=1):
        if not issubclass(before.gives, after.takes):
            raise ConfigError(
                f"Compose: step {position + 1}, {type(after).__name__}, takes a {after.takes.__name__} but step "
                f"{position}, {type(before).__name__}, gives a {before.gives.__name__}"
                + ("; put Deproject between them" if before.gives is not PointCloud else "")
            )
    for position, step in enumerate(steps, start=1):
        where = f"Compose: step {position}, {type(step).__name__},"
        needed = step.frame_needed()
        if frame is not None and needed is not None and needed != frame:
            raise ConfigError(f"{where} works in frame {needed!r} but the cloud is in {frame!r} there")
        wanted = step.unit_needed()
        if unit is not None and wanted is not None and wanted != unit:
            names = {METRE: "in metres", NORMALIZED: "normalised"}
            works = "in metres" if wanted == METRE else "on normalised clouds"
            raise ConfigError(f"{where} works {works} but the cloud is {names[unit]} there; {unit_advice(step)}")
        frame = step.frame_after(frame)
        unit = step.unit_given() or wanted or unit


def _warn_statistics_before_crop(steps: Sequence[Transform]) -> None:
    names = [type(step).__name__ for step in steps]
    early = next((i for i, step in enumerate(steps) if step.runs_statistics), len(steps))
    if "CropWorkspace" in names[early:] and "CropWorkspace" not in names[:early]:
        warnings.warn(
            f"{names[early]} runs before CropWorkspace: cropping first is cheaper, and statistics of the workspace "
            "alone find more of its outliers",
            PipelineOrderWarning,
            stacklevel=5,  # check_fields, __post_init__, __init__, then the caller
        )
