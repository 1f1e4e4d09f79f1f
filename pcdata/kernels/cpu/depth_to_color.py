"""Depth registered to color in the compiled core."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.dispatch import OPERATIONS, kernel
from pcdata.functional.depth.depth_to_color import RegisteredDepth, check_cameras, half_pixels
from pcdata.geometry.lens import plain_lenses
from pcdata.kernels.cameras import rays_of_cameras
from pcdata.kernels.cpu.native import answers, call, room_for

# The core numbers the pixels of an image with 32 bits.
_MOST_PIXELS = 2**32 - 1


@kernel("register_depth", "cpu")
def register_depth(
    depth: Tensor,
    intrinsics: Tensor,
    color_intrinsics: Tensor,
    color_from_depth: Tensor,
    *,
    color_size: tuple[int, int],
    distortion: Tensor | None,
    color_distortion: Tensor | None,
    max_jump: float,
) -> RegisteredDepth:
    """Project and paint a few rows at a time; what floats and the core's lens cannot hold is left to the reference."""
    check_cameras(depth, intrinsics, distortion, color_intrinsics, color_distortion, color_from_depth)
    views, height, width = depth.shape
    color_shape = (views, *color_size)
    lenses = None if color_distortion is None else plain_lenses(color_distortion)
    if (color_distortion is None or lenses is not None) and 0 < height * width <= _MOST_PIXELS and views > 0:
        rays = rays_of_cameras(intrinsics, (height, width), distortion)
        results = room_for(
            (color_shape, torch.float32),
            (color_shape, torch.int64),
            (color_shape, torch.bool),
            (depth.shape, torch.bool),
        )
        possible = answers()
        call(
            "pc_register_depth",
            *(depth.contiguous(), views, height, width, *rays),
            *(color_from_depth.contiguous(), color_intrinsics.double().contiguous()),
            half_pixels(intrinsics, color_intrinsics, color_from_depth).contiguous(),
            lenses,
            *(*color_size, float(max_jump), *results, possible),
        )
        if possible[0]:
            return RegisteredDepth(*results)
    reference: RegisteredDepth = OPERATIONS["register_depth"].reference(
        depth,
        intrinsics,
        color_intrinsics,
        color_from_depth,
        color_size=color_size,
        distortion=distortion,
        color_distortion=color_distortion,
        max_jump=max_jump,
    )
    return reference
