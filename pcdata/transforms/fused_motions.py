"""Motions and jitter in a row, and a dropout behind them, as one pass over the points.

Each step by itself would read all points from memory and fill as much memory anew. What is decided without a look at
the points can be decided for all these steps first; :class:`Compose` then takes every point through them at once,
rounded after each step as the single steps round, and writes those that stay. The clouds and their histories are those
of the single steps, bit for bit; and whatever they would refuse is left to them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.contracts.on_host import bounds_of, counts_of
from pcdata.errors import PcdataError
from pcdata.functional.motions import draw_motions
from pcdata.functional.noise import PointStep, move_points
from pcdata.functional.rows import pick_rows, rows_of_mask
from pcdata.functional.stored_rows import gather_kept
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.structures.kinds import attributes
from pcdata.structures.structure import derived
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.drawn_motions import Drawn, DrawnMotion, drawn_table, num_words
from pcdata.transforms.families import SpatialTransform
from pcdata.transforms.random_jitter import RandomJitter, RandomPointDropout
from pcdata.transforms.random_motions import RandomFlip, RandomRotation, RandomScale, RandomShear, RandomTranslation

# Fields that no motion changes, and the points, which one pass changes.
_UNMOVED = ("points", "colors", "source_index")


def motions_from(steps: Sequence[Transform], position: int) -> int:
    """Return how many steps, from one on, can run as one."""
    count = 0
    for step in steps[position:]:
        if step._forward_hooks or step._forward_pre_hooks:  # somebody watches it
            break
        if type(step) is RandomPointDropout:  # the rows behind it are other ones
            return count + 1
        if not _is_blind(step):
            break
        count += 1
    return count


def read_by_motions(steps: Sequence[Transform]) -> Sequence[str]:
    """Return the fields that :func:`run_motions` reads once of the first of some steps: where they lie will do."""
    together = motions_from(steps, 0)
    if not together:
        return ()
    return _UNMOVED if type(steps[together - 1]) is RandomPointDropout else ("points",)


def _is_blind(step: Transform) -> bool:
    """Whether a step moves points, or adds noise, without having looked at them."""
    # Exact types: a subclass may do something else.
    if type(step) in (RandomRotation, RandomScale, RandomShear, RandomFlip):
        return vars(step)["about"] == "origin"
    return type(step) is RandomTranslation or (type(step) is RandomJitter and step.is_plain)


def run_motions(
    steps: Sequence[Transform],
    cloud: PointCloud,
    streams: Streams,
    *,
    in_place: bool = False,
    sources: Mapping[str, Tensor] | None = None,
) -> PointCloud | None:
    """Run steps that :func:`motions_from` found; None where they must be run one by one, with the same draws.

    ``in_place``: the rows are nobody else's, and their memory takes the result. ``sources`` are the addresses where
    the rows of each cloud lie, by the names of the fields that the cloud does not hold yet.
    """
    before = streams.place
    try:
        return _run(steps, cloud, streams, in_place, sources)
    except PcdataError:
        streams.place = before
        return None  # the step that refuses says why


def _run(
    steps: Sequence[Transform],
    cloud: PointCloud,
    streams: Streams,
    in_place: bool,
    sources: Mapping[str, Tensor] | None,
) -> PointCloud:
    points, ptr = cloud.points, cloud.ptr
    decided = _decided(steps, cloud, streams)
    done: list[PointStep] = []
    kept: tuple[Tensor, Tensor] | None = None
    motions = [one["matrix"] for one, _ in decided if "matrix" in one]
    if motions:
        cloud = cloud.with_facts_moved(torch.stack(motions))
    counts = counts_of(ptr)
    for step, (params, drawn) in zip(steps, decided, strict=True):
        before, told = counts, counts if step.decides_by == "count" else None
        if isinstance(step, SpatialTransform):
            done.append(params["matrix"])
        elif isinstance(step, RandomJitter):
            done.append(step.point_step(params))
        else:
            kept = params["index"], params["ptr"]
            counts = counts_of(kept[1])
        cloud = step.recorded_counts(cloud, before, counts, params, drawn=drawn, rows=told)
    layout = cloud.layout if len(motions) == len(done) else None  # noise leaves no point on its pixel
    # Nothing is refused from here on: memory may change.
    rows, left = cloud.fields(), dict(sources or {})
    if kept is not None:
        cloud = derived(cloud, ptr=kept[1])
    others = dict(rows)
    if done:
        moved = move_points(points, ptr, done, kept, in_place=in_place, sources=left.pop("points", None))
        rows["points"] = moved
        del others["points"]
    if left:
        rows |= gather_kept({name: others.pop(name) for name in left}, left, ptr, kept)
    if kept is not None and others:
        mask = kept[0]
        wanted = mask if mask.is_cpu else rows_of_mask(mask, bounds_of(kept[1])[-1])
        rows |= pick_rows(others, wanted, in_place=in_place)
    return derived(cloud, **attributes(rows), layout=layout)


def _decided(steps: Sequence[Transform], cloud: PointCloud, streams: Streams) -> list[tuple[Params, NDArray[np.int64]]]:
    """Return what each step decides, and the streams as they were before; none looks at what another does.

    Motions are drawn all at once.
    """
    begin, keys = streams.place, torch.from_numpy(streams.here())
    decided: list[tuple[Params, NDArray[np.int64]]] = []
    together: dict[int, tuple[Drawn, int]] = {}
    for number, step in enumerate(steps):
        step.check_input(cloud)
        before = streams.here()
        drawn = step.drawn() if isinstance(step, DrawnMotion) else None
        if drawn is None:
            decided.append((step.make_params(cloud, streams), before))
        else:
            decided.append(({}, before))
            together[number] = drawn, streams.place - begin
            streams.take(num_words(drawn))
    if together:
        table = drawn_table(*map(tuple, zip(*together.values(), strict=True)))
        for number, matrix in zip(together, draw_motions(keys, table, len(together)), strict=True):
            decided[number][0]["matrix"] = matrix
    return decided
