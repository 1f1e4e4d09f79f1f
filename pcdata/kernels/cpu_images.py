"""Image kernels: from depth images to points."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from pcdata.dispatch import INNER, OPERATIONS, Operation, kernel
from pcdata.functional.depth import check_intrinsics, check_rays, pixel_rays
from pcdata.kernels.native import addresses, call


@kernel("deproject_depth", "cpu")
def deproject_depth(depth: Tensor, intrinsics: Tensor, *, distortion: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Count the readings of every image row, then write every row's points at once."""
    check_intrinsics("deproject_depth", intrinsics)
    depth = depth.contiguous()
    starts = _row_starts(depth)
    if starts is None:
        return _reference(OPERATIONS["deproject_depth"], depth, intrinsics, distortion=distortion)
    points, pixel_index, _, _ = _deproject(depth, intrinsics, distortion, starts, over_all_views=False)
    return points, _ptr_of(starts, depth), pixel_index


@kernel("deproject_images", "cpu")
def deproject_images(
    depth: Tensor,
    intrinsics: Tensor,
    distortion: Tensor | None,
    colors: Tensor | None,
    images: Mapping[str, Tensor],
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, dict[str, Tensor]]:
    """Write the points and all that goes along with them in the same pass."""
    check_intrinsics("deproject_depth", intrinsics)
    depth = depth.contiguous()
    starts = _row_starts(depth)
    if starts is None:
        return _reference(INNER["deproject_images"], depth, intrinsics, distortion, colors, images)
    points, source_index, rgb, rows = _deproject(
        depth, intrinsics, distortion, starts, over_all_views=True, colors=colors, images=list(images.values())
    )
    return points, _ptr_of(starts, depth), source_index, rgb, dict(zip(images, rows))


def _row_starts(depth: Tensor) -> Tensor | None:
    """Return (V * H + 1,): where the points of each image row start; None for a depth that the reference refuses."""
    views, height, width = depth.shape
    starts, possible = torch.empty(views * height + 1, dtype=torch.int64), torch.empty(1, dtype=torch.int64)
    call("pc_count_readings", depth, views, height, width, starts, possible)
    return starts if possible else None


def _deproject(
    depth: Tensor,
    intrinsics: Tensor,
    distortion: Tensor | None,
    starts: Tensor,
    *,
    over_all_views: bool,
    colors: Tensor | None = None,
    images: Sequence[Tensor] = (),
) -> tuple[Tensor, Tensor, Tensor | None, list[Tensor]]:
    """Return points, pixel numbers, colours and the rows of the images."""
    views, height, width = depth.shape
    count = int(starts[-1])
    points, pixel_index = torch.empty((count, 3), dtype=torch.float32), torch.empty(count, dtype=torch.int64)
    rgb = None if colors is None else torch.empty_like(points)
    images = [image.contiguous() for image in images]
    rows = [image.new_empty((count, *image.shape[3:])) for image in images]
    crossed = None if distortion is not None else _crossed_rays(intrinsics, (height, width))
    rays = None
    if crossed is None:
        crossed = None, None
        rays = _cached_rays(_Key(intrinsics), (height, width), None if distortion is None else _Key(distortion))
        check_rays("deproject_depth", rays, depth > 0)
    pixel_bytes = torch.tensor([image[0, 0, 0].nbytes for image in images], dtype=torch.int64)
    call(
        "pc_deproject",
        *(depth, views, height, width, *crossed, rays, starts),
        *(points, pixel_index, over_all_views, None if colors is None else colors.contiguous(), rgb),
        *(len(images), addresses(images), pixel_bytes, addresses(rows)),
    )
    return points, pixel_index, rgb, rows


def _ptr_of(starts: Tensor, depth: Tensor) -> Tensor:
    views, height, _ = depth.shape
    return starts[torch.arange(views + 1) * height]


def _crossed_rays(intrinsics: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor] | None:
    """Return x/z of every column (V, W) and y/z of every row (V, H); None if a skew makes x depend on the row."""
    if bool((intrinsics[:, 0, 1] != 0).any()):
        return None
    top = pixel_rays(intrinsics, (1, size[1]))[:, 0, :, 0]
    left = pixel_rays(intrinsics, (size[0], 1))[:, :, 0, 1]
    # An infinite y would make x NaN in the reference.
    return (top.float(), left.float()) if bool(left.isfinite().all()) else None


class _Key:
    """A small tensor that a cache can look up by value."""

    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor.detach().clone()
        self.value = tensor.dtype, tuple(tensor.shape), tuple(tensor.flatten().tolist())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self.value == other.value

    def __hash__(self) -> int:
        return hash(self.value)


@functools.lru_cache(maxsize=4)  # 7 MB each at 1280x720: one per camera of a usual rig
def _cached_rays(intrinsics: _Key, size: tuple[int, int], distortion: _Key | None) -> Tensor:
    return pixel_rays(intrinsics.tensor, size, None if distortion is None else distortion.tensor).float().contiguous()


def _reference(operation: Operation, *args: Any, **kwargs: Any) -> Any:
    """Let the reference say what is wrong with the depth."""
    return operation.reference(*args, **kwargs)
