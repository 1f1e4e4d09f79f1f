"""Selections in a row: what none of them looks at is picked once, behind the last.

Each step by itself would copy every field of the rows that it leaves, for the next to copy most of them again.
:class:`Compose` therefore sets fields aside that no step of the run looks at: colors, normals, labels. They come back
for the rows that are left, from where they lay; right behind a deprojection that is the images themselves. And where a
step can decide among the rows that the one before it keeps, as they lie, rows are picked once for both. The clouds and
their histories are those of the single steps, bit for bit; and whatever they would refuse is left to them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.known import FINITE, UNSHARED, is_known, note
from pcdata.contracts.on_host import counts_of
from pcdata.errors import PcdataError
from pcdata.functional.rows import pick_rows
from pcdata.structures import Kind, PointCloud
from pcdata.structures.kinds import attributes
from pcdata.structures.structure import derived
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.families import SelectTransform

_MIN_ROWS = 1 << 15
_LEAST_BYTES = 12  # of each row that is set aside: its number, which is carried along instead, has four
_NUMBER = "number of the row"  # no identifier, so no field of anybody's


def selections_from(steps: Sequence[Transform], position: int) -> int:
    """Return how many steps, from one on, only pick rows, and are known to look at some fields alone."""
    count = 0
    for step in steps[position:]:
        if not isinstance(step, SelectTransform) or step.is_random or step._forward_hooks or step._forward_pre_hooks:
            break
        # A subclass of somebody's may look at more than the step that it is made of.
        if not type(step).__module__.startswith("pcdata.") or step.looks_at() is None:
            break
        count += 1
    return count


def are_many(rows: int) -> bool:
    """Say whether so many rows are worth it: a few are copied sooner than anything is set aside."""
    return rows >= _MIN_ROWS


def looked_at(steps: Sequence[Transform]) -> set[str]:
    """Return the fields that any of the steps that :func:`selections_from` found looks at."""
    found: set[str] = set()
    for step in steps:
        assert isinstance(step, SelectTransform)
        found.update(step.looks_at() or ())
    return found


def pick_together(steps: Sequence[Transform]) -> bool:
    """Say whether a step behind the first may decide among the rows that the one before it keeps."""
    return any(_decides_within(step, 1.0) for step in steps[1:])


@dataclass(frozen=True)
class SetAside:
    """Fields that rows have where they came from, and how a cloud says which rows these are."""

    fields: Mapping[str, Tensor]  # (R, ...) each; colors of images are uint8
    kinds: Mapping[str, Kind]  # of all extra fields of the whole cloud, in their order
    by: str  # the field with the row, 0..R-1

    @classmethod
    def of_images(cls, images: Mapping[str, Tensor], colors: Tensor | None, kinds: Mapping[str, Kind]) -> SetAside:
        """Set (V, H, W, ...) images aside from points that know their pixels, counted over all views."""
        fields = {name: image.flatten(0, 2) for name, image in images.items()}
        if colors is not None:
            fields["colors"] = colors.reshape(-1, 3)
        return cls(fields, kinds, "source_index")

    @classmethod
    def of_cloud(cls, cloud: PointCloud, kept: Collection[str]) -> tuple[SetAside, PointCloud] | None:
        """Set aside all but some fields of a cloud; None where that saves nothing."""
        fields = {name: value for name, value in cloud.fields().items() if name not in kept and name != "points"}
        if sum(value.element_size() * math.prod(value.shape[1:]) for value in fields.values()) < _LEAST_BYTES:
            return None
        extra = {name: value for name, value in cloud.extra.items() if name in kept}
        extra[_NUMBER] = torch.arange(cloud.num_points, dtype=torch.int32, device=cloud.device)
        kinds = {name: cloud.kinds.get(name, Kind.INVARIANT) for name in extra}
        gone: dict[str, Any] = {name: None for name in fields if name not in cloud.extra}
        return cls(fields, cloud.kinds, _NUMBER), derived(cloud, **gone, extra=extra, kinds=kinds)

    def back(self, cloud: PointCloud) -> PointCloud:
        """Return what is left with all its fields."""
        rows = cloud.fields()
        number = rows.pop(_NUMBER, None)
        picked = pick_rows(self.fields, (rows[self.by] if number is None else number).long())
        if "colors" in picked and picked["colors"].dtype is torch.uint8:
            picked["colors"] = picked["colors"].float().div_(255)
        whole = attributes({**rows, **picked})
        whole["extra"] = {name: whole["extra"][name] for name in self.kinds}
        return derived(cloud, **whole, kinds=self.kinds)


def run_selections(
    steps: Sequence[Transform],
    positions: range,
    cloud: PointCloud,
    aside: SetAside | None,
    told: Callable[[range, PointCloud], None],
) -> tuple[PointCloud, int]:
    """Run the steps at some positions, which :func:`selections_from` found; return what is left, and where they stop.

    That is behind the last, or at one that refuses: run by itself it says why. ``told`` is called behind each that
    picks rows, with the positions of those that this is for and with what they left, without the fields set aside.
    """
    chosen: Params | None = None  # decided, and not picked yet
    start, stop = positions.start, positions.stop
    for position in positions:
        behind = steps[position + 1] if position + 1 < positions.stop else None
        try:
            cloud, chosen = _run(steps[position], cloud, chosen, behind)
        except (PcdataError, Warning):  # a warning may be an error to the caller
            stop = position
            break
        if chosen is None:
            told(range(start, position + 1), cloud)
            start = position + 1
    if chosen is not None:
        cloud = cloud.select(chosen["index"], chosen["ptr"])
        told(range(start, stop), cloud)
    return (cloud if aside is None else aside.back(cloud)), stop


def _run(
    step: Transform, cloud: PointCloud, chosen: Params | None, behind: Transform | None
) -> tuple[PointCloud, Params | None]:
    """Run one step; return also what is chosen of the cloud, where the step behind it takes that as it lies."""
    may_wait = cloud.device.type == "cpu" and _decides_within(behind, 1.0)
    if chosen is None and not (may_wait and type(step).transform is SelectTransform.transform):
        return step(cloud), None
    assert isinstance(step, SelectTransform)
    step.check_input(cloud)
    if chosen is None:
        before, params = counts_of(cloud.ptr), step.make_params(cloud, step.no_streams)
    else:
        before, params = counts_of(chosen["ptr"]), step.params_within(cloud, chosen["index"], chosen["ptr"])
    after = counts_of(params["ptr"])
    cloud = step.recorded_counts(cloud, before, after, params, rows=step.told_rows(cloud, params))
    index = params["index"]
    may_wait = may_wait and index.dtype is torch.bool and is_known(FINITE, cloud.points)
    if may_wait and _decides_within(behind, sum(after) / max(1, index.shape[0])):
        return step.with_facts(cloud, cloud, params), params
    cloud = step.transform(cloud, params)
    note(UNSHARED, cloud.points)
    return cloud, None


def _decides_within(step: Transform | None, share: float) -> bool:
    return isinstance(step, SelectTransform) and step.decides_within(share)
