"""The depth images that the points of a merged cloud came from, told by its cameras and the points themselves."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.touching import View
from pcdata.structures import Camera, PointCloud

_PIXELS_OFF = 0.6  # a point belongs to the pixel that it is seen in


def merged_views(cloud: PointCloud, b: int) -> list[View] | None:
    """Return which rows of cloud ``b`` lie on which pixels of each image that MergeViews joined.

    None where the cloud is not merged, where a lens bends its images, or where points no longer lie where their pixels
    saw them: averaged, jittered, repeated.
    """
    own = cloud[b]
    cameras = own.meta[0].get("cameras", [])
    if "view" not in own.extra or own.source_index is None or not cameras:
        return None
    views = []
    for number, facts in enumerate(cameras):
        camera = Camera.from_dict(facts)
        world, pose = facts.get("world_frame"), facts.get("world_from_camera")
        if (
            camera.distortion is not None
            or pose is None
            or not {world} <= {own.source_frame, own.frame_id, *own.frames}
        ):
            return None
        height, width = camera.size
        rows = (own.extra["view"] == number).nonzero().squeeze(1)
        pixel = own.source_index[rows] % (height * width)
        order = pixel.argsort(stable=True)
        rows, pixel = rows[order], pixel[order]
        world_from_camera = torch.tensor(pose, dtype=torch.float64, device=own.device)
        motion = torch.linalg.inv(world_from_camera)[None] @ own.frame_from_cloud(world)
        grid = ImageGrid(pixel, (height, width), camera.intrinsics.to(own.device), motion)
        if bool((pixel[1:] == pixel[:-1]).any()) or not _lie_on(own.points[rows], grid):
            return None
        views.append(View(rows, grid))
    return views


def _lie_on(points: Tensor, grid: ImageGrid) -> bool:
    """Whether every point is seen in its own pixel."""
    assert grid.camera_from_points is not None
    motion, k, width = grid.camera_from_points[0], grid.intrinsics[0], grid.size[1]
    seen = points.double() @ motion[:3, :3].T + motion[:3, 3]
    z = seen[:, 2]
    place = torch.stack([grid.pixel_index % width, grid.pixel_index // width], 1)
    off = (seen @ k.double().T)[:, :2] / z.clamp(min=1e-9)[:, None] - place
    return bool(((z > 0) & (off.abs() < _PIXELS_OFF).all(1)).all())
