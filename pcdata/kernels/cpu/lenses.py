"""Lenses inverted, and images sampled where a map says."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.dispatch import OPERATIONS, kernel
from pcdata.functional.depth.undistortion import undistortion_map
from pcdata.geometry import radial_lenses
from pcdata.geometry.lens import CONVERGED, MAX_STEPS
from pcdata.kernels.cpu.native import call, room, room_for


@kernel("unbent", "cpu")
def unbent(target: Tensor, twelve: Tensor, after: bool, fold: float) -> Tensor:
    """Take the steps of some coordinates side by side."""
    solved = room(target.shape, torch.float64)
    lens = torch.cat([twelve.double(), twelve.new_tensor([float(after), fold], dtype=torch.float64)])
    call("pc_unbend", target.double().contiguous(), len(target), lens, MAX_STEPS, CONVERGED, solved)
    return solved


@kernel("fisheye_rays", "cpu")
def fisheye_rays(xy: Tensor, coefficients: Tensor, largest: float) -> Tensor:
    """Take the steps of some rays side by side."""
    solved = room(xy.shape, torch.float64)
    arrays = xy.double().contiguous(), len(xy), coefficients.double().contiguous()
    call("pc_unbend_fisheye", *arrays, largest, radial_lenses.MAX_STEPS, radial_lenses.CONVERGED, solved)
    return solved


@kernel("undistort_image", "cpu")
def undistort_image(
    *,
    image: Tensor,
    intrinsics: Tensor,
    distortion: Tensor,
    new_intrinsics: Tensor | None,
    size: tuple[int, int] | None,
    rule: str,
) -> tuple[Tensor, Tensor]:
    """Sample uint8 and float32 images in one pass; the map is that of the reference."""
    cameras = {"new_intrinsics": new_intrinsics, "size": size}
    if not image.numel() or image.dtype is torch.float64:
        found: tuple[Tensor, Tensor] = OPERATIONS["undistort_image"].reference(
            image, intrinsics, distortion, **cameras, rule=rule
        )
        return found
    views, height, width, channels = image.shape
    shape = size or (height, width)
    at = undistortion_map(intrinsics, distortion, new_intrinsics, shape)
    sampled, valid = room_for(((views, *shape, channels), image.dtype), ((views, *shape), torch.bool))
    whole = image.dtype is torch.uint8
    call(
        "pc_sample_image",
        *((image, None) if whole else (None, image)),
        *(views, height, width, channels, at.contiguous(), shape[0] * shape[1], int(rule == "nearest")),
        *((sampled, None) if whole else (None, sampled)),
        valid,
    )
    return sampled, valid


@kernel("undistort_depth", "cpu")
def undistort_depth(
    *,
    depth: Tensor,
    intrinsics: Tensor,
    distortion: Tensor,
    new_intrinsics: Tensor | None,
    size: tuple[int, int] | None,
    rule: str,
    max_jump: float,
) -> tuple[Tensor, Tensor]:
    """Sample in one pass; the map is that of the reference."""
    if not depth.numel():
        cameras = {"new_intrinsics": new_intrinsics, "size": size}
        found: tuple[Tensor, Tensor] = OPERATIONS["undistort_depth"].reference(
            depth, intrinsics, distortion, **cameras, rule=rule, max_jump=max_jump
        )
        return found
    views, height, width = depth.shape
    shape = size or (height, width)
    at = undistortion_map(intrinsics, distortion, new_intrinsics, shape)
    sampled, pixel_index = room_for(((views, *shape), torch.float32), ((views, *shape), torch.int64))
    arrays = depth, views, height, width, at.contiguous(), shape[0] * shape[1]
    call("pc_sample_depth", *arrays, int(rule == "surface"), max_jump, sampled, pixel_index)
    return sampled, pixel_index
