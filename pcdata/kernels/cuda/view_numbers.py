"""What the kernels of fusion read of a view besides its images, kept on the device: most cameras stand still."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.on_host import on_host, uploaded
from pcdata.functional.tsdf import integrate
from pcdata.functional.tsdf.grid import VoxelGrid
from pcdata.functional.tsdf.views import FusionView

OF_RAYS, OF_VOXELS = slice(0, 15), slice(15, 54)  # those of RaysInBlocks and of ProjectedVoxels
_MOST_KEPT = 64

_kept: dict[tuple[Any, ...], Tensor] = {}


def numbers_of(view: FusionView, grid: VoxelGrid) -> Tensor:
    """Return (54,) float64 on the device of the view; the same camera in the same place is sent once."""
    device = view.depth.device
    # What one stream has sent, another may read too early.
    stream = torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0
    pose, lens = (None if one is None else on_host(one) for one in (view.world_from_camera, view.distortion))
    key = device, stream, grid, view.pinhole, _bytes_of(pose), _bytes_of(lens)
    found = _kept.get(key)
    if found is None:
        if len(_kept) >= _MOST_KEPT:
            _kept.pop(next(iter(_kept)), None)
        found = _kept[key] = uploaded(_worked_out(view, grid), device)
    return found


def _worked_out(view: FusionView, grid: VoxelGrid) -> Tensor:
    turn, fraction, camera = integrate.camera_in_blocks(view, grid)
    image = integrate.image_from_world(view)
    steps = (image[:, :3] * grid.voxel_size).float()
    lens = torch.zeros(13, dtype=torch.float32, device="cpu")
    if view.distortion is not None and len(view.distortion) == 12:  # others are not for kernels
        lens[:12], lens[12] = on_host(view.distortion).float(), view.fold
    pinhole = torch.tensor(view.pinhole, dtype=torch.float32, device="cpu")
    parts = [turn, fraction, camera, image, steps, pinhole, lens]
    return torch.cat([part.double().flatten() for part in parts])


def _bytes_of(tensor: Tensor | None) -> bytes | None:
    return None if tensor is None else tensor.numpy().tobytes()
