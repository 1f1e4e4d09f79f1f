"""Two scenes in one: mix_scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.on_host import counts_of
from pcdata.errors import DTypeError, FrameError, ShapeError
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts, segment_max
from pcdata.structures import PointCloud
from pcdata.structures.kinds import Kind


def mix_scenes(
    first: PointCloud,
    second: PointCloud,
    *,
    apart: Sequence[str] = ("labels",),
    params: Sequence[Mapping[str, Any]] | None = None,
) -> PointCloud:
    """Put cloud b of ``second`` into cloud b of ``first``: a scene with the objects of both.

    Numbers of objects are kept apart: those of the second scene follow the highest of the first (-1, none, stays). The
    field ``scene`` says which one a point is of, 0 or 1. Each point keeps the viewpoint that saw it; points of the
    second scene are no pixels of the first, so their ``source_index`` is -1. Frames, meta, signals and history are
    those of the first, and its history tells the ``sample_id`` of the second, as ``partner``. In a dataset:
    :class:`~pcdata.MixedCloudDataset`.

    Args:
        first: B clouds.
        second: B clouds in the same frame and unit, with the same fields.
        apart: integer fields that number objects; all others, such as labels of classes, stay as they are.
        params: for each cloud, what the history tells of it instead.

    Raises:
        ShapeError: they are not as many.
        FrameError: they are in different frames or units, or of one alone it is known where the sensor stood.
        DTypeError: they have different fields, or one that is to be kept apart is missing or no integers.

    Source: Nekrasov et al., Mix3D: Out-of-context data augmentation for 3D scenes, 3DV 2021.
    """
    _check_pair(first, second)
    first, second = _with_viewpoints(first, second)
    ours, theirs = cloud_of_rows(first.ptr), cloud_of_rows(second.ptr)
    order = torch.cat([ours, theirs]).argsort(stable=True)
    own, others = first.fields(), second.fields()
    for name in apart:
        if name not in own or own[name].ndim != 1 or own[name].is_floating_point() or own[name].dtype is torch.bool:
            raise DTypeError(
                f"mix_scenes: {name!r} is to be kept apart, so it must be a field of one integer per point; the "
                f"clouds have {sorted(own)}; give apart=() where nothing numbers objects"
            )
        others[name] = _after(own[name], first.ptr, others[name], theirs)
    if first.source_index is not None:
        others["source_index"] = torch.full_like(others["source_index"], -1)
    fields = {name: torch.cat([value, others[name]])[order] for name, value in own.items()}
    scene = torch.cat([torch.zeros_like(ours), torch.ones_like(theirs)])[order]
    mixed = first.with_rows(fields, ptr_from_counts(first.counts + second.counts))
    if params is None:
        params = [{"partner": entry.get("sample_id")} for entry in second.meta]
    note = {"step": "mix_scenes", "version": 1, "fields": {"apart": [*apart]}, "frame": first.frame_id}
    counts = zip(counts_of(first.ptr), counts_of(mixed.ptr), params, strict=True)
    steps = [
        {**note, "unit": first.unit, "params": {**told}, "points_before": before, "points": after}
        for before, after, told in counts
    ]
    return mixed.with_extra("scene", scene, Kind.INVARIANT).with_steps(steps)


def _check_pair(first: PointCloud, second: PointCloud) -> None:
    if first.num_clouds != second.num_clouds:
        raise ShapeError(f"mix_scenes: takes as many clouds of each, got {first.num_clouds} and {second.num_clouds}")
    if (first.frame_id, first.unit) != (second.frame_id, second.unit):
        raise FrameError(
            f"mix_scenes: the first clouds are in {first.frame_id!r} [{first.unit}], the second in "
            f"{second.frame_id!r} [{second.unit}]; bring them into one by ToFrame"
        )
    if first.kinds != second.kinds or first.fields().keys() != second.fields().keys():
        raise DTypeError(
            f"mix_scenes: the first clouds have {sorted(first.fields())}, the second {sorted(second.fields())}; give "
            "both the same fields"
        )
    if "scene" in first.extra:
        raise DTypeError("mix_scenes: the clouds are mixed already: they have the field 'scene'; give it another name")
    if (first.viewpoint is None) != (second.viewpoint is None):
        known, unknown = ("first", "second") if second.viewpoint is None else ("second", "first")
        raise FrameError(
            f"mix_scenes: of the {known} clouds it is known where the sensor stood, of the {unknown} it is not; set "
            "PointCloud.viewpoint of both or of none"
        )


def _with_viewpoints(first: PointCloud, second: PointCloud) -> tuple[PointCloud, PointCloud]:
    """Give every point the viewpoint of its cloud."""
    if first.viewpoint is None:
        return first, second
    both = []
    for cloud in (first, second):
        seen_from = cloud.viewpoint_per_point()
        assert seen_from is not None
        both.append(replace(cloud, viewpoint=None).with_extra("viewpoint", seen_from, Kind.POSITION))
    return both[0], both[1]


def _after(own: Tensor, ptr: Tensor, others: Tensor, owner: Tensor) -> Tensor:
    """Number the others' objects behind the highest of the own cloud; what is below 0 is none."""
    highest = segment_max(own, ptr).clamp(min=-1).to(others.dtype)
    return torch.where(others < 0, others, others + (highest + 1)[owner])
