"""The surfaces that the views of a capture saw, for alignment."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from pcdata.alignment.surfaces import Surface, cloud_surface, depth_surface
from pcdata.errors import FrameError, ShapeError, UnitError
from pcdata.functional.rows import transform_points
from pcdata.geometry import rigid
from pcdata.structures import CAMERA_FRAME, METRE, DepthFrame, PointCloud
from pcdata.threads import in_threads


def surfaces_of(
    where: str, capture: DepthFrame | PointCloud, *, max_samples: int
) -> tuple[list[Surface], Tensor]:  # V surfaces, world_from_view (V, 4, 4) float64
    """Return the surface of every view and where the calibration says the view is.

    A cloud that still lies on its depth images is put back into them, so that visibility is known.

    Raises:
        ShapeError: there are fewer than two views.
        FrameError: the views are not in one common frame, or their poses are unknown.
        UnitError: the cloud is not in metres.
    """
    if isinstance(capture, PointCloud):
        return _of_clouds(where, capture, max_samples)
    if capture.num_views < 2:
        raise ShapeError(
            f"{where}: comparing cameras needs two views or more, the capture has {capture.num_views}; give a frame of "
            "all cameras, as a folder with one folder per camera is read"
        )
    if capture.world_from_camera is None:
        raise FrameError(
            f"{where}: capture {capture.sample_id!r} has no world_from_camera, so its views are not related to "
            "each other; give their poses, or a calibration that has them (calibration=, posed=)"
        )
    camera = capture.camera.to(capture.device)

    def surface(view: int) -> Surface:
        lens = None if camera.distortion is None else camera.distortion[view]
        return depth_surface(capture.depth[view], camera.intrinsics[view], lens, max_samples=max_samples)

    return in_threads(surface, range(capture.num_views)), capture.world_from_camera


def _of_clouds(where: str, cloud: PointCloud, max_samples: int) -> tuple[list[Surface], Tensor]:
    if cloud.num_clouds < 2:
        raise ShapeError(
            f"{where}: comparing cameras needs one cloud per view, two or more, got {cloud.num_clouds}; "
            "do it before MergeViews"
        )
    if cloud.frame_id == CAMERA_FRAME:
        raise FrameError(
            f"{where}: the views are still in {CAMERA_FRAME!r}, each in its own camera's frame; "
            "add ToFrame(frame=...) before it"
        )
    if cloud.unit != METRE:
        raise UnitError(f"{where}: the limits are in metres but the cloud's unit is {cloud.unit!r}")
    if cloud.image_grid() is not None and rigid.is_rigid(cloud.source_from_cloud):
        return _of_images(cloud, max_samples), rigid.invert_rigid(cloud.source_from_cloud)
    seen_from = cloud.viewpoint_per_point()
    bounds = cloud.ptr.tolist()
    surfaces = [
        cloud_surface(
            cloud.points[start:stop],
            None if seen_from is None else seen_from[start:stop],
            max_samples=max_samples,
        )
        for start, stop in itertools.pairwise(bounds)
    ]
    return surfaces, torch.eye(4, dtype=torch.float64, device=cloud.device).repeat(cloud.num_clouds, 1, 1)


def _of_images(cloud: PointCloud, max_samples: int) -> list[Surface]:
    """Write the points' depths back into the pixels they came from."""
    grid = cloud.image_grid()
    assert grid is not None
    depth = transform_points(cloud.points, cloud.ptr, cloud.source_from_cloud)[:, 2]
    bounds = cloud.ptr.tolist()
    surfaces: list[Surface] = []
    for view, (start, stop) in enumerate(itertools.pairwise(bounds)):
        image = depth.new_zeros(grid.size[0] * grid.size[1])
        image[grid.pixel_index[start:stop]] = depth[start:stop]
        surfaces.append(depth_surface(image.reshape(grid.size), grid.intrinsics[view], max_samples=max_samples))
    return surfaces
