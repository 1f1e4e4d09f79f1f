"""The usual beginning of a chain in one go: MaskDepth, RemoveFlyingPixels, Deproject, ToFrame, CropWorkspace.

Between these steps lie an image and two clouds of every pixel, and filling fresh memory with them takes longer than all
arithmetic. :class:`Compose` therefore runs them together when nobody looks in between. The cloud, its history and its
provenance are those of the single steps, bit for bit; and whatever they would refuse is left to them.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Sequence

import torch
from torch import Tensor

from pcdata.contracts.known import FINITE, UNSHARED, note
from pcdata.contracts.on_host import counts_of, read_together
from pcdata.errors import PcdataError
from pcdata.functional.depth.boxed import deproject_into_box
from pcdata.functional.depth.deproject import Deprojected
from pcdata.functional.image_grid import pixels_rise
from pcdata.structures import DepthFrame, PointCloud
from pcdata.structures.image_layout import pixels_of_views
from pcdata.structures.structure import derived
from pcdata.transforms.base import Data, Params, Transform
from pcdata.transforms.crop import CropWorkspace
from pcdata.transforms.deproject import Deproject, MaskDepth
from pcdata.transforms.depth_filters import RemoveFlyingPixels
from pcdata.transforms.families import MaskTransform
from pcdata.transforms.frames import ToFrame
from pcdata.transforms.fused_selections import SetAside, are_many, looked_at


def find_beginning(steps: Sequence[Transform]) -> slice | None:
    """Return where [MaskDepth,] [RemoveFlyingPixels,] Deproject, [ToFrame,] CropWorkspace stand, or None."""
    # Exact types: a subclass may do something else.
    kinds = [type(step) for step in steps]
    if Deproject not in kinds:
        return None
    start = kinds.index(Deproject)
    stop = start + 1
    if kinds[stop : stop + 1] == [ToFrame]:
        stop += 1
    crop = steps[stop] if stop < len(steps) else None
    if type(crop) is not CropWorkspace or not crop.is_plain:
        return None
    # A limit to what a step may remove needs its readings counted.
    for kind in (RemoveFlyingPixels, MaskDepth):
        before = steps[start - 1] if start else None
        if isinstance(before, MaskTransform) and type(before) is kind and before.max_drop is None:
            start -= 1
    return slice(start, stop + 1)


def run_beginning(
    steps: Sequence[Transform], frame: Data, *, behind: Sequence[Transform] = ()
) -> tuple[PointCloud, SetAside | None] | None:
    """Run the steps that :func:`find_beginning` found; None where they must be run one by one.

    ``behind`` them selections may follow: what none of these looks at is left out of the cloud, and told beside it.
    """
    if not isinstance(frame, DepthFrame):
        return None
    for step in steps:
        if step._forward_hooks or step._forward_pre_hooks:  # somebody watches it
            return None
    try:
        return _run(steps, frame, looked_at(behind) if behind else None)
    except PcdataError:
        return None  # the step that refuses says why


def _run(
    steps: Sequence[Transform], frame: DepthFrame, needed: Collection[str] | None
) -> tuple[PointCloud, SetAside | None] | None:
    by_type = {type(step): step for step in steps}
    mask, flying, deproject, move, crop = map(
        by_type.get, (MaskDepth, RemoveFlyingPixels, Deproject, ToFrame, CropWorkspace)
    )
    assert isinstance(deproject, Deproject)
    assert isinstance(crop, CropWorkspace)
    assert not isinstance(crop.lower, str)  # is_plain
    assert not isinstance(crop.upper, str)
    near = far = region = None
    if isinstance(mask, MaskDepth):
        near, far, region = mask.near, mask.far, mask.mask_of(frame)
        frame = mask.recorded(frame, frame, {})
    if isinstance(flying, RemoveFlyingPixels):
        frame = flying.recorded(frame, frame, {})
    images, colors = deproject.images_of(frame), frame.colors
    aside = None
    if needed is not None and are_many(frame.depth.numel()):
        left_out = {name: image for name, image in images.items() if name not in needed}
        aside = SetAside.of_images(left_out, None if "colors" in needed else colors, deproject.kinds_of(images))
        images = {name: image for name, image in images.items() if name in needed}
        colors = colors if "colors" in needed else None
    # Without rows, the steps do all that they do but for the rows.
    bare = deproject.cloud_of(frame, _nothing(frame, colors, images))
    moved, moves = bare, Params()
    if isinstance(move, ToFrame):
        move.check_input(bare)
        moves = move.make_params(bare, move.no_streams)
        moved = move.transform(bare, moves)
    crop.check_input(moved)
    matrix = moves.get("matrix")
    done = deproject_into_box(
        frame.depth,
        *deproject.cameras_of(frame),
        colors,
        images,
        matrix=None if matrix is None else matrix.to(frame.device),
        lower=crop.lower,
        upper=crop.upper,
        near=near,
        far=far,
        mask=region,
        # The confidence of what is kept stays.
        flying=(flying.tolerance, flying.min_neighbors) if isinstance(flying, RemoveFlyingPixels) else None,
    )
    if done is None:
        return None
    made, readings = done
    note(FINITE, made.points)  # they are within the box
    note(UNSHARED, made.points)
    if frame.num_views == 1:
        note(pixels_rise(frame.size), made.source_index, made.ptr)
    cloud = derived(
        moved,
        points=made.points,
        ptr=made.ptr,
        colors=made.colors,
        labels=made.rows.get("labels"),
        source_index=made.source_index,
        extra={name: made.rows[name] for name in moved.extra},
    )
    note(pixels_of_views(frame.size), made.source_index, made.ptr)
    before, after = read_together([readings])[0], counts_of(cloud.ptr)
    cloud = deproject.recorded_counts(cloud, None, before, {}, place=(bare.frame_id, bare.unit))
    if isinstance(move, ToFrame):
        cloud = move.recorded_counts(cloud, before, before, moves)
    return crop.recorded_counts(cloud, before, after, {}), aside


def _nothing(frame: DepthFrame, colors: Tensor | None, images: dict[str, Tensor]) -> Deprojected:
    """Return what no reading at all gives."""
    kinds = tuple([(name, image.dtype, image.shape[3:]) for name, image in images.items()])
    return _empty(frame.device, frame.num_views, colors is not None, kinds)


@functools.lru_cache(maxsize=64)
def _empty(
    device: torch.device, views: int, has_colors: bool, kinds: tuple[tuple[str, torch.dtype, torch.Size], ...]
) -> Deprojected:
    points = torch.empty((0, 3), dtype=torch.float32, device=device)
    return Deprojected(
        points=points,
        ptr=torch.zeros(views + 1, dtype=torch.int64, device=device),
        source_index=torch.empty(0, dtype=torch.int64, device=device),
        colors=points if has_colors else None,
        rows={name: torch.empty((0, *shape), dtype=dtype, device=device) for name, dtype, shape in kinds},
    )
