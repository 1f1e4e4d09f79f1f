"""Image kernels: from depth images to points.

Deprojection takes two passes over the pixels: the first decides which become points, so that the second can write them,
and all that goes along with them, where they belong.
"""

from __future__ import annotations

import ctypes
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

import pcdata.functional.depth.boxed  # noqa: F401 - the function must be registered before its kernel
from pcdata.contracts.dispatch import INNER, OPERATIONS, kernel
from pcdata.functional.depth.deproject import Deprojected, check_intrinsics
from pcdata.functional.depth.looks import DepthLook
from pcdata.kernels.cameras import Rays, depth_limits, images_fit, rays_of_cameras, region_fits
from pcdata.kernels.cpu.native import addresses, answers, call, numbers, room, room_for


@kernel("mask_depth", "cpu")
def mask_depth(depth: Tensor, near: float | None, far: float | None, mask: Tensor | None) -> Tensor:
    """Decide and write in one pass."""
    if mask is not None and (mask.shape != depth.shape or mask.dtype is not torch.bool):
        return INNER["mask_depth"].reference(depth, near, far, mask)
    masked = torch.empty_like(depth, memory_format=torch.contiguous_format)
    limits = depth_limits(near, far)
    call("pc_mask_depth", depth.contiguous(), depth.numel(), *limits, _contiguous(mask), masked)
    return masked


@kernel("look_at_depth", "cpu")
def look_at_depth(depth: Tensor, before: Tensor | None = None, copy: Tensor | None = None) -> DepthLook:
    """Read, compare and copy in one pass; it compares until the first difference."""
    for other in (before, copy):
        if other is not None and (other.shape != depth.shape or other.dtype is not torch.float32):
            raise ValueError(f"look_at_depth: {tuple(other.shape)} {other.dtype} beside {tuple(depth.shape)}")
    extremes, same = answers(2, ctypes.c_float), answers()
    call("pc_look_at_depth", depth.contiguous(), depth.numel(), _contiguous(before), copy, extremes, same)
    least, largest = extremes
    return DepthLook(least, largest, bool(same[0]))


@kernel("deproject_depth", "cpu")
def deproject_depth(depth: Tensor, intrinsics: Tensor, *, distortion: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Write the points and their pixels."""
    cameras = _Cameras.of(depth, intrinsics, distortion)
    chosen = cameras.choose()
    if chosen is None:
        return OPERATIONS["deproject_depth"].reference(depth, intrinsics, distortion=distortion)
    made = cameras.deproject(chosen, over_all_views=False)
    return made.points, made.ptr, made.source_index


@kernel("deproject_images", "cpu")
def deproject_images(
    depth: Tensor,
    intrinsics: Tensor,
    distortion: Tensor | None,
    colors: Tensor | None,
    images: Mapping[str, Tensor],
) -> Deprojected:
    """Write the points and all that goes along with them."""
    if not images_fit(depth, intrinsics, distortion, colors, images):
        return INNER["deproject_images"].reference(depth, intrinsics, distortion, colors, images)
    cameras = _Cameras.of(depth, intrinsics, distortion)
    chosen = cameras.choose()
    if chosen is None:
        return INNER["deproject_images"].reference(depth, intrinsics, distortion, colors, images)
    return cameras.deproject(chosen, colors=colors, images=images)


@kernel("deproject_into_box", "cpu")
def deproject_into_box(
    depth: Tensor,
    intrinsics: Tensor,
    distortion: Tensor | None,
    colors: Tensor | None,
    images: Mapping[str, Tensor],
    *,
    matrix: Tensor | None,
    lower: Sequence[float],
    upper: Sequence[float],
    near: float | None,
    far: float | None,
    mask: Tensor | None,
    flying: tuple[float, int] | None = None,
) -> tuple[Deprojected, Tensor] | None:
    """Write only what is inside the box."""
    chosen = None
    if images_fit(depth, intrinsics, distortion, colors, images) and region_fits(depth, matrix, mask):
        cameras = _Cameras.of(depth, intrinsics, distortion)
        matrix = None if matrix is None else matrix.double().contiguous()
        corners = _corners(tuple(lower), tuple(upper))
        chosen = cameras.choose(depth_limits(near, far), mask, matrix, *corners, flying=flying)
    if chosen is None:
        region = {"lower": lower, "upper": upper, "near": near, "far": far, "mask": mask, "flying": flying}
        return INNER["deproject_into_box"].reference(
            depth, intrinsics, distortion, colors, images, matrix=matrix, **region
        )
    return cameras.deproject(chosen, matrix=matrix, colors=colors, images=images), chosen.readings


@dataclass(frozen=True)
class _Chosen:
    """Which pixels become points."""

    depth: Tensor  # (V, H, W)
    keep: Tensor  # (V, H, W) bool
    readings: Tensor  # (V,) int64: those that the box decided about
    starts: Tensor  # (V * H + 1,) int64: where the points of each image row start


@dataclass(frozen=True)
class _Cameras:
    """Depth images and the directions in which their pixels look."""

    depth: Tensor  # (V, H, W)
    rays: Rays

    @classmethod
    def of(cls, depth: Tensor, intrinsics: Tensor, distortion: Tensor | None) -> _Cameras:
        check_intrinsics("deproject_depth", intrinsics)
        return cls(depth.contiguous(), rays_of_cameras(intrinsics, (depth.shape[1], depth.shape[2]), distortion))

    def choose(
        self,
        limits: tuple[float, float] = (0.0, math.inf),
        mask: Tensor | None = None,
        matrix: Tensor | None = None,
        lower: Tensor | None = None,
        upper: Tensor | None = None,
        *,
        flying: tuple[float, int] | None = None,
    ) -> _Chosen | None:
        """Decide about every pixel; None where there is none, or something wrong that the reference says best.

        With ``flying``, a tolerance and a number of neighbors, of the pixels within the limits those that fly go first.
        """
        if self.depth.numel() == 0:
            return None
        depth, mask, (views, height, width) = self.depth, _contiguous(mask), self.depth.shape
        keep = room(depth.shape, torch.bool)
        readings, possible = room(views, torch.int64), answers()
        starts = room(views * height + 1, torch.int64)
        if flying is not None:  # with nothing to do before the next call, for which the core's threads stay awake
            tolerance, min_neighbors = flying
            left = room(depth.shape, torch.float32)
            rule = True, *limits, mask, float(tolerance), min_neighbors
            call("pc_without_flying_pixels", depth, views, height, width, *rule, None, left, None)
            depth, limits, mask = left, (0.0, math.inf), None
        call(
            "pc_choose_pixels",
            *(depth, views, height, width, *self.rays),
            *(*limits, mask, matrix, lower, upper),
            *(keep, readings, starts, possible),
        )
        return _Chosen(depth, keep, readings, starts) if possible[0] else None

    def deproject(
        self,
        chosen: _Chosen,
        *,
        over_all_views: bool = True,
        matrix: Tensor | None = None,
        colors: Tensor | None = None,
        images: Mapping[str, Tensor] | None = None,
    ) -> Deprojected:
        """Write the chosen points, moved by the matrix."""
        views, height, width = chosen.depth.shape
        bounds = chosen.starts.numpy()[::height].tolist()
        count = bounds[-1]
        sources = {name: image.contiguous() for name, image in (images or {}).items()}
        core = [
            ((count, 3), torch.float32),
            ((count,), torch.int64),
            ((count if colors is not None else 0, 3), torch.float32),
        ]
        copied = [((count, *image.shape[3:]), image.dtype) for image in sources.values()]
        points, pixel_index, rgb, *rows = room_for(*core, *copied)
        copying: tuple[Any, ...] = 0, None, None, None
        if sources:
            pixel_bytes = numbers([image.nbytes // chosen.depth.numel() for image in sources.values()])
            copying = len(sources), addresses(sources.values()), pixel_bytes, addresses(rows)
        call(
            "pc_deproject",
            *(chosen.depth, views, height, width, *self.rays, matrix, chosen.keep, chosen.starts),
            *(points, pixel_index, over_all_views, _contiguous(colors), rgb, *copying),
        )
        ptr = torch.from_numpy(np.array(bounds, np.int64))
        return Deprojected(points, ptr, pixel_index, None if colors is None else rgb, dict(zip(sources, rows)))


@functools.lru_cache(maxsize=64)
def _corners(*corners: tuple[float, ...]) -> tuple[Tensor, ...]:
    """Return the corners of a box, float32, as the core reads them."""
    return tuple(torch.tensor(corner, dtype=torch.float32, device="cpu") for corner in corners)


def _contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.contiguous()
