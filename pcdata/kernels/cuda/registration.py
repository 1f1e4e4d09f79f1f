"""Depth registered to color: cells painted into a z-buffer by all threads at once."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.dispatch import OPERATIONS, kernel
from pcdata.contracts.on_host import on_host, read_together, uploaded
from pcdata.functional.depth.depth_to_color import RegisteredDepth, check_cameras, half_pixels
from pcdata.geometry.lens import plain_lenses
from pcdata.kernels.cameras import rays_of_cameras
from pcdata.kernels.cuda.launching import launcher_of


@kernel("register_depth", "cuda")
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
    """Wait once, to know whether floats and the kernels' lens could hold all; what they cannot is the reference's."""
    check_cameras(depth, intrinsics, distortion, color_intrinsics, color_distortion, color_from_depth)
    device, (views, height, width) = depth.device, depth.shape
    color_shape = (views, *color_size)
    lenses = None if color_distortion is None else plain_lenses(on_host(color_distortion))
    if (color_distortion is None or lenses is not None) and depth.numel() > 0:
        launcher = launcher_of(depth)
        halves = half_pixels(*(on_host(one) for one in (intrinsics, color_intrinsics, color_from_depth)))
        seen = torch.empty((4, *depth.shape), dtype=torch.float32, device=device)
        given = (
            *(depth.contiguous(), views, height, width, *rays_of_cameras(intrinsics, (height, width), distortion)),
            *(None, color_from_depth.contiguous(), color_intrinsics.double().contiguous()),
            *(uploaded(halves.contiguous(), device), None if lenses is None else uploaded(lenses, device), seen),
        )
        registered = torch.empty(color_shape, dtype=torch.float32, device=device)
        pixel_index = torch.full(color_shape, -1, dtype=torch.int64, device=device)  # keys until they are read
        occluding = torch.empty(color_shape, dtype=torch.bool, device=device)
        hidden = torch.empty(depth.shape, dtype=torch.bool, device=device)
        impossible = torch.zeros(1, dtype=torch.int32, device=device)
        launcher.launch("pc_see_readings", depth.numel(), *given, impossible)
        launcher.launch("pc_paint_cells", depth.numel(), *given, impossible, max_jump, *color_size, pixel_index)
        launcher.launch("pc_read_keys", registered.numel(), registered.numel(), pixel_index, registered, occluding)
        found = registered, hidden, occluding
        launcher.launch("pc_find_hidden", depth.numel(), *given, 1 + max_jump, *color_size, *found)
        if not read_together([impossible])[0][0]:
            return RegisteredDepth(registered, pixel_index, occluding, hidden)
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
