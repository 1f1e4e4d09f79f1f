"""The peer of fusion: Open3D's tensor VoxelBlockGrid, with the truncation, the weights and the colours that pcdata has.

Its legacy ScalableTSDFVolume integrates nothing in release 0.20. It reads the pixel that a projection is rounded down
to, so it takes integer coordinates for pixel corners: half a pixel is added to the principal point, which makes it read
the nearest one, as pcdata does. (Given the intrinsics as they are, its surfaces lie half a pixel to the side.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import open3d as o3d
import torch
from torch import Tensor

from pcdata.structures import DepthFrame

_BLOCK = 16  # voxels along an edge, the value of Open3D's examples
_FAR = 10.0  # metres, beyond every reading


def open3d_grid(voxel_size: float, num_blocks: int = 10_000) -> Any:
    """An empty grid with distance, weight and colour."""
    return o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(o3d.core.float32, o3d.core.float32, o3d.core.float32),
        attr_channels=((1), (1), (3)),
        voxel_size=voxel_size,
        block_resolution=_BLOCK,
        block_count=num_blocks,
        device=o3d.core.Device("CPU:0"),
    )


def open3d_integrate(grid: Any, frame: DepthFrame, voxel_size: float, truncation: float) -> None:
    """Integrate the one view of a frame."""
    assert frame.world_from_camera is not None
    assert frame.colors is not None
    depth = o3d.t.geometry.Image(o3d.core.Tensor(frame.depth[0].numpy()))
    color = o3d.t.geometry.Image(o3d.core.Tensor(frame.colors[0].numpy().astype(np.float32) / 255))
    corners = frame.camera.intrinsics[0].numpy().copy()
    corners[:2, 2] += 0.5
    k = o3d.core.Tensor(corners)
    pose = o3d.core.Tensor(np.linalg.inv(frame.world_from_camera[0].numpy()))
    multiple = truncation / voxel_size
    blocks = grid.compute_unique_block_coordinates(depth, k, pose, 1.0, _FAR, multiple)
    grid.integrate(blocks, depth, color, k, k, pose, 1.0, _FAR, multiple)


def open3d_surface(frames: Sequence[DepthFrame], voxel_size: float) -> Tensor:
    """(N, 3) float32: the points of a truncation of 5 voxels, of all that was seen at least once."""
    grid = open3d_grid(voxel_size)
    for frame in frames:
        open3d_integrate(grid, frame, voxel_size, 5 * voxel_size)
    cloud = grid.extract_point_cloud(weight_threshold=0.5)
    return torch.from_numpy(cloud.point.positions.numpy().copy())
