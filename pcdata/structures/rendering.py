"""A cloud, a mesh or a fused volume as a camera would see it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.errors import CaptureError, DTypeError, FrameError, ShapeError
from pcdata.functional.rendering import render_points, render_triangles
from pcdata.functional.rows import transform_points
from pcdata.functional.shading import shaded
from pcdata.geometry import rigid
from pcdata.structures.camera import Camera
from pcdata.structures.depth_frame import DepthFrame
from pcdata.structures.kinds import CAMERA_FRAME
from pcdata.structures.point_cloud import PointCloud
from pcdata.structures.surface_mesh import SurfaceMesh
from pcdata.structures.tsdf_volume import TSDFVolume


@dataclass(frozen=True, eq=False)
class Rendered:
    """What cameras would see.

    Args:
        frame: depth, and the colors (black) and labels (-1) of what is in front where the cloud has them.
        normals: (V, H, W, 3) float32 in each camera's frame, zero where nothing is; None = the cloud has none.
        index: (V, H, W) int64 rows of the points or triangles in front; their number where there is nothing.
    """

    frame: DepthFrame
    normals: Tensor | None
    index: Tensor


class _Front(NamedTuple):
    """What is in front, and the points of the cloud that make it up: one, or the corners of a triangle."""

    depth: Tensor  # (V, H, W)
    item: Tensor  # (V, H, W) int64 point or triangle in front, at least num_items where nothing is
    num_items: int
    corners: Tensor | None = None  # (T, 3) points of the triangles
    weights: Tensor | None = None  # (V, H, W, 3) float32 of the corners

    def of(self, values: Tensor, *, as_bytes: bool = False) -> Tensor:  # (V, H, W, 3)
        """Mix values (N, 3) of the points at every pixel."""
        weights = None if self.weights is None else self.weights.flatten(0, 2)
        item = self.item.flatten()
        mixed = shaded(values, item, self.num_items, self.corners, weights, as_bytes=as_bytes)
        return mixed.reshape(*self.item.shape, 3)

    def nearest_point(self) -> tuple[Tensor, Tensor]:
        """Return which pixels (V, H, W) see something, and the point that each of them (P,) sees nearest."""
        found = self.item < self.num_items
        front = self.item[found]
        if self.corners is None or self.weights is None:
            return found, front
        return found, self.corners[front].gather(1, self.weights[found].argmax(1, keepdim=True))[:, 0]


def render(
    shown: PointCloud | SurfaceMesh | TSDFVolume,
    camera: Camera,
    world_from_camera: Tensor | None = None,  # (V, 4, 4) float64 rigid; None = the cloud is in the camera's frame
    *,
    point_size: float = 0.0,
) -> Rendered:
    """Render a single cloud, a mesh or the surface of a volume in every camera, with its colors, normals and labels.

    Points are squares ``point_size`` metres wide at their depth, one pixel at least. Meshes and volumes are met by the
    ray of each pixel; colors and normals are mixed from the corners, the label is that of the nearest corner.

    Args:
        shown: in one frame, that the poses lead to.
        camera: V cameras.
        world_from_camera: where they are, in the frame of what is shown.
        point_size: of points; meshes have none.

    Raises:
        DTypeError: something else is shown.
        ShapeError: more than one cloud, or another number of poses than cameras.
        FrameError: a pose is given and the cloud is in the camera's frame, or none and it is not.
        PoseError: a pose is not rigid.
        CaptureError: a size of points where meshes are shown.
    """
    where = "render"
    shown = shown.extract_mesh() if isinstance(shown, TSDFVolume) else shown
    if not isinstance(shown, (PointCloud, SurfaceMesh)):
        raise DTypeError(f"{where}: clouds, meshes and volumes are rendered, not a {type(shown).__name__}")
    cloud = shown.vertices if isinstance(shown, SurfaceMesh) else shown
    if cloud.num_clouds != 1:
        raise ShapeError(f"{where}: one cloud is rendered, got {cloud.num_clouds}; choose one, or join them")
    views = camera.num_views
    if (cloud.frame_id == CAMERA_FRAME) != (world_from_camera is None):
        given = "no pose is given" if world_from_camera is None else "a pose is given"
        raise FrameError(
            f"{where}: the cloud is in {cloud.frame_id!r} and {given}; world_from_camera says where the cameras are in "
            "that frame, and clouds in 'camera' need none"
        )
    if point_size and isinstance(shown, SurfaceMesh):
        raise CaptureError(f"{where}: triangles have no point_size; leave it out")
    matrix = torch.eye(4, dtype=torch.float64, device=cloud.points.device).repeat(views, 1, 1)
    if world_from_camera is not None:
        if tuple(world_from_camera.shape) != (views, 4, 4):
            raise ShapeError(
                f"{where}: world_from_camera must be ({views}, 4, 4), got {tuple(world_from_camera.shape)}"
            )
        rigid.check_rigid(f"{where}: world_from_camera", world_from_camera)
        matrix = rigid.invert_rigid(world_from_camera.double())
    front = _front(shown, camera, matrix, point_size)
    depth = front.depth
    normals = colors = labels = None
    if cloud.normals is not None:
        mixed = torch.nn.functional.normalize(front.of(cloud.normals), dim=-1)
        normals = (mixed.flatten(1, 2) @ matrix[:, :3, :3].float().mT).reshape(mixed.shape)
    if cloud.colors is not None:
        colors = front.of(cloud.colors, as_bytes=True)
    if cloud.labels is not None:
        found, rows = front.nearest_point()
        labels = torch.full(depth.shape, -1, dtype=torch.int64, device=depth.device)
        labels[found] = cloud.labels[rows]
    frame = DepthFrame(
        depth=depth,
        camera=camera,
        colors=colors,
        labels=labels,
        world_from_camera=world_from_camera,
        frame_id=None if world_from_camera is None else cloud.frame_id,
    )
    return Rendered(frame=frame, normals=normals, index=front.item)


def _front(shown: PointCloud | SurfaceMesh, camera: Camera, matrix: Tensor, point_size: float) -> _Front:
    """Render what is shown in all views at once; matrix (V, 4, 4) leads to the cameras."""
    cloud = shown.vertices if isinstance(shown, SurfaceMesh) else shown
    views, points = camera.num_views, cloud.points
    starts = torch.arange(views + 1, dtype=torch.int64, device=matrix.device)
    if views > 1 or cloud.frame_id != CAMERA_FRAME:
        points = transform_points(points.repeat(views, 1), starts * cloud.num_points, matrix)
    k, lens, size = camera.intrinsics, camera.distortion, camera.size
    if isinstance(shown, SurfaceMesh):
        total = len(shown.triangles)
        corners = points.reshape(views, -1, 3)[:, shown.triangles].flatten(0, 1)
        seen = render_triangles(corners, starts * total, intrinsics=k, distortion=lens, size=size)
        index = _within_view(seen.triangle_index, total, views)
        return _Front(seen.depth, index, total, shown.triangles, seen.weights)
    total = cloud.num_points
    spots = render_points(points, starts * total, intrinsics=k, distortion=lens, size=size, point_size=point_size)
    return _Front(spots.depth, _within_view(spots.point_index, total, views), total)


def _within_view(index: Tensor, total: int, views: int) -> Tensor:
    """Number the items of each view from 0 on: those of all follow one another; ``total`` is nothing."""
    if views == 1:
        return index
    return torch.where(index < views * total, index % max(1, total), total)
