"""Running the steps of a chain: several in one pass where that gives the same, else one after another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor

from pcdata.contracts.known import forget, keeping_known, knowing_nothing
from pcdata.functional.stored_rows import gather_kept
from pcdata.rng import GeneratorLike, Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Data, Transform, num_clouds
from pcdata.transforms.fused_beginning import run_beginning
from pcdata.transforms.fused_motions import motions_from, run_motions
from pcdata.transforms.fused_selections import (
    SetAside,
    are_many,
    looked_at,
    pick_together,
    run_selections,
    selections_from,
)

Told = Callable[[range, Any], None]  # positions of steps that have run, what they gave


def _nobody(positions: range, data: Any) -> None:
    """Hear it."""


@keeping_known()
def run_steps(
    steps: Sequence[Transform],
    data: Data,
    position: int,
    generator: GeneratorLike | None,
    *,
    beginning: slice | None,
    is_own: bool = False,
    sources: Mapping[str, Tensor] | None = None,
    told: Told = _nobody,
) -> Any:
    """Run the steps from a position on.

    Args:
        steps: of the chain.
        data: what the first to run takes.
        position: of that one.
        generator: one for all, or streams; None = no step is random.
        beginning: the steps that one call of the core can do, see :func:`find_beginning`.
        is_own: nobody else holds the clouds, so their memory may be used for the result.
        sources: where rows of the clouds lie, see :meth:`pcdata.transforms.compose.Compose.consume`.
        told: called behind every pass.
    """
    singly = 0  # up to this step, selections are not run together: one of them refuses
    while position < len(steps):
        if beginning is not None and position == beginning.start:
            begun = _begun(steps, beginning, data, told)
            if begun is not None:
                data, position, singly = begun
                continue
        together = motions_from(steps, position)
        if together > 1 - is_own and isinstance(data, PointCloud):
            assert generator is not None
            generator = Streams.of(generator, num_clouds(data))
            own = steps[position : position + together]
            cloud = run_motions(own, data, generator, in_place=is_own, sources=sources)
            if cloud is not None:
                forget()  # the memory may be that of the clouds before
                data, position, sources = cloud, position + together, None
                told(range(position - together, position), data)
                continue
        if sources and isinstance(data, PointCloud):
            gather_kept({name: getattr(data, name) for name in sources}, sources, data.ptr)
        sources = None
        # What a step gives may share its memory with what it got, or with its params.
        is_own = False
        if position >= singly and isinstance(data, PointCloud):
            singly = position + selections_from(steps, position)
            selected = _selected(steps, range(position, singly), data, told)
            if selected is not None:
                data, position = selected
                continue
        data, generator = run_step(steps[position], data, generator)
        position += 1
        told(range(position - 1, position), data)
    return data


def _begun(steps: Sequence[Transform], beginning: slice, data: Data, told: Told) -> tuple[PointCloud, int, int] | None:
    """Run the beginning and the selections behind it; return the cloud, the next step, and the first to be joined.

    None where the steps must be run one by one.
    """
    stop = beginning.stop + selections_from(steps, beginning.stop)
    done = run_beginning(steps[beginning], data, behind=steps[beginning.stop : stop])
    if done is None:
        return None
    cloud, aside = done
    told(range(beginning.start, beginning.stop), cloud)
    if aside is None:
        return cloud, beginning.stop, beginning.stop
    return *run_selections(steps, range(beginning.stop, stop), cloud, aside, told), stop


def _selected(
    steps: Sequence[Transform], positions: range, cloud: PointCloud, told: Told
) -> tuple[PointCloud, int] | None:
    """Run selections together; return also the next step. None where there are not two to be run so."""
    if len(positions) < 2:
        return None
    together = steps[positions.start : positions.stop]
    parts = SetAside.of_cloud(cloud, looked_at(together)) if are_many(cloud.num_points) else None
    if parts is not None:
        return run_selections(steps, positions, parts[1], parts[0], told)
    return run_selections(steps, positions, cloud, None, told) if pick_together(together) else None


def run_step(step: Transform, data: Data, generator: GeneratorLike | None) -> tuple[Data, GeneratorLike | None]:
    """Run one step; return also the generator of those behind it."""
    own = None
    if step.is_random:
        # One stream per cloud, split off once: random steps in a row draw from the same streams, so that running only
        # the random suffix on a stored prefix gives the same draws.
        assert generator is not None
        own = generator = Streams.of(generator, num_clouds(data))
    if step._forward_hooks or step._forward_pre_hooks or _is_foreign(step):
        with knowing_nothing():
            return step(data, generator=own), generator
    return step(data, generator=own), generator


def _is_foreign(step: Transform) -> bool:
    """Say whether code that is not pcdata's runs in a step: nobody knows what it does to what it has in hand."""
    within = step.parts() if step._modules else ()
    return any(not type(part).__module__.startswith("pcdata.") for part in (step, *within))
