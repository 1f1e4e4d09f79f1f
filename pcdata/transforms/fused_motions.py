"""Motions and jitter in a row, and a dropout behind them, as one pass over the points.

Each step by itself would read all points from memory and fill as much memory anew. What is decided without a look at
the points can be decided for all these steps first; :class:`Compose` then takes every point through them at once,
rounded after each step as the single steps round, and writes those that stay. The clouds and their histories are those
of the single steps, bit for bit; and whatever they would refuse is left to them.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from pcdata.errors import PcdataError
from pcdata.functional.noise import PointStep, move_points
from pcdata.functional.rows import listed_counts, pick_rows
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.structures.kinds import attributes
from pcdata.structures.structure import derived
from pcdata.transforms.base import Transform
from pcdata.transforms.families import SpatialTransform
from pcdata.transforms.random_jitter import RandomJitter, RandomPointDropout
from pcdata.transforms.random_motions import RandomFlip, RandomRotation, RandomScale, RandomTranslation


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


def moves_blindly(steps: Sequence[Transform]) -> bool:
    """Whether the first of some steps moves points, or adds noise, in a way that :func:`run_motions` takes."""
    return bool(steps) and motions_from(steps[:1], 0) == 1 and _is_blind(steps[0])


def _is_blind(step: Transform) -> bool:
    """Whether a step moves points, or adds noise, without having looked at them."""
    # Exact types: a subclass may do something else.
    if type(step) in (RandomRotation, RandomScale, RandomFlip):
        return vars(step)["about"] == "origin"
    return type(step) is RandomTranslation or (type(step) is RandomJitter and step.is_plain)


def run_motions(
    steps: Sequence[Transform],
    cloud: PointCloud,
    streams: Streams,
    *,
    in_place: bool = False,
    sources: Tensor | None = None,
) -> PointCloud | None:
    """Run steps that :func:`motions_from` found; None where they must be run one by one, with the same draws.

    ``in_place``: the rows are nobody else's, and their memory takes the result. ``sources`` are the addresses where the
    points of each cloud lie, which the cloud does not hold yet.
    """
    before = streams.place
    try:
        return _run(steps, cloud, streams, in_place, sources)
    except PcdataError:
        streams.place = before
        return None  # the step that refuses says why


def _run(
    steps: Sequence[Transform], cloud: PointCloud, streams: Streams, in_place: bool, sources: Tensor | None
) -> PointCloud:
    points, ptr = cloud.points, cloud.ptr
    done: list[PointStep] = []
    kept: tuple[Tensor, Tensor] | None = None
    decided, counts = [], listed_counts(ptr)
    for step in steps:  # none changes the frame or the unit, or looks at the points
        step.check_input(cloud)
        drawn = streams.here()
        params = step.make_params(cloud, streams)
        decided.append((params, drawn, step.told_rows(cloud, params)))
        if isinstance(step, SpatialTransform):
            done.append(params["matrix"])
        elif isinstance(step, RandomJitter):
            done.append(step.point_step(params))
        else:
            kept = params["index"], params["ptr"]
    motions = [one for one in done if isinstance(one, Tensor)]
    if motions:
        cloud = cloud.with_facts_moved(motions)
    layout = cloud.layout if len(motions) == len(done) else None  # noise leaves no point on its pixel
    for step, (params, drawn, told) in zip(steps, decided, strict=True):
        after = listed_counts(params["ptr"]) if "ptr" in params else counts
        cloud = step.recorded_counts(cloud, counts, after, params, drawn=drawn, rows=told)
        counts = after
    # Nothing is refused from here on: memory may change.
    rows = cloud.fields()
    if kept is not None:
        cloud = derived(cloud, ptr=kept[1])
    if done or sources is not None:
        rows["points"] = move_points(points, ptr, done, kept, in_place=in_place, sources=sources)
    if kept is not None:
        others = {name: value for name, value in rows.items() if name != "points" or not (done or sources is not None)}
        rows |= pick_rows(others, kept[0], in_place=in_place)
    return derived(cloud, **attributes(rows), layout=layout)
