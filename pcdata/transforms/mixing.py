"""Two scenes in one: mix_scenes."""

from __future__ import annotations

import torch

from pcdata.errors import DTypeError, FrameError, ShapeError
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts, segment_max
from pcdata.structures import PointCloud
from pcdata.structures.kinds import Kind


def mix_scenes(first: PointCloud, second: PointCloud) -> PointCloud:
    """Put cloud b of ``second`` into cloud b of ``first``: a scene with the objects of both.

    Labels are kept apart: those of the second scene follow the highest of the first (-1, none, stays), and the field
    ``scene`` says which one a point is of, 0 or 1. Frames, meta, signals and history are those of the first. Mix after
    augmentation, as Mix3D does: ``mix_scenes(batch, PointCloud.cat([*batch[1:], batch[0]]))``.

    Args:
        first: B clouds.
        second: B clouds in the same frame and unit, with the same fields.

    Raises:
        ShapeError: they are not as many.
        FrameError: they are in different frames or units.
        DTypeError: they have different fields.

    Source: Nekrasov et al., Mix3D: Out-of-context data augmentation for 3D scenes, 3DV 2021.
    """
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
    ours, theirs = cloud_of_rows(first.ptr), cloud_of_rows(second.ptr)
    order = torch.cat([ours, theirs]).argsort(stable=True)
    fields = {name: torch.cat([value, second.fields()[name]])[order] for name, value in first.fields().items()}
    if first.labels is not None and second.labels is not None:
        highest = segment_max(first.labels, first.ptr).clamp(min=-1)
        moved = torch.where(second.labels < 0, second.labels, second.labels + (highest + 1)[theirs])
        fields["labels"] = torch.cat([first.labels, moved])[order]
    scene = torch.cat([torch.zeros_like(ours), torch.ones_like(theirs)])[order]
    mixed = first.with_rows(fields, ptr_from_counts(first.counts + second.counts))
    return mixed.with_extra("scene", scene, Kind.INVARIANT)
