"""Keeping what a camera sees: CropFrustum, RemoveHiddenPoints."""

from __future__ import annotations

import math
from typing import Annotated

import torch
from annotated_types import Ge
from torch import Tensor

from pcdata.errors import ConfigError, FrameError, PcdataError
from pcdata.functional.rows import ptr_after_mask, transform_points
from pcdata.functional.visibility import frustum_mask, hidden_point_mask
from pcdata.geometry import rigid
from pcdata.rng import Streams
from pcdata.structures import Camera, PointCloud
from pcdata.transforms.families import RemoveTransform
from pcdata.transforms.field_types import Count, Matrix4, Metres, Name, Positive, Vec3


class CropFrustum(RemoveTransform):
    """Keep the points inside the view of a camera that need not have taken them, hidden by others or not.

    Args:
        frame: the frame that the camera's pose leads to.
        frame_from_camera: rigid; the camera looks along its z axis, x to the right, y down.
        fx: focal length in pixels.
        fy: likewise.
        cx: principal point in pixels; integers are centers of pixels.
        cy: likewise.
        size: (height, width) of the image.
        near: metres along z; None = all before the camera.
        far: metres along z; None = no limit.
        lens: the model of its distortion, see docs/lenses.md; None = OpenCV's.
        distortion: the lens's coefficients; None = a pinhole.
        invert: keep what is outside.
    """

    needs_metres = True
    decides_by = "point"

    frame: Name
    frame_from_camera: Matrix4
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    size: tuple[Count, Count]
    near: Metres | None = None
    far: Metres | None = None
    lens: Name | None = None
    distortion: tuple[float, ...] | None = None
    invert: bool = False

    def check_fields(self) -> None:
        """Require a rigid pose, a camera, and near < far."""
        if self.near is not None and self.far is not None and self.near >= self.far:
            raise ConfigError(f"CropFrustum: near must be below far, got near={self.near}, far={self.far}")
        try:
            rigid.check_rigid("CropFrustum.frame_from_camera", self._pose())
            self._camera()
        except PcdataError as error:
            raise ConfigError(str(error)) from error

    def _pose(self) -> Tensor:
        return torch.tensor(self.frame_from_camera, dtype=torch.float64, device="cpu")

    def _camera(self) -> Camera:
        return Camera.pinhole(
            fx=self.fx,
            fy=self.fy,
            cx=self.cx,
            cy=self.cy,
            size=self.size,
            distortion=self.distortion,
            lens=self.lens,
        )

    def frame_needed(self) -> str:
        """The frame of the camera's pose."""
        return self.frame

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Pick the rows in view."""
        camera = self._camera().to(cloud.device)
        pose = rigid.invert_rigid(self._pose()).to(cloud.device)
        one = torch.tensor([0, cloud.num_points], dtype=torch.int64, device=cloud.device)
        seen = frustum_mask(
            transform_points(cloud.points, one, pose[None]),
            intrinsics=camera.intrinsics,
            distortion=camera.distortion,
            size=self.size,
            near=self.near or 0.0,
            far=math.inf if self.far is None else self.far,
        )
        keep = seen != self.invert
        return keep, ptr_after_mask(keep, cloud.ptr)


class RemoveHiddenPoints(RemoveTransform):
    """Drop the points that the cloud's own surfaces hide from a viewpoint: of a whole object what one camera sees.

    Args:
        viewpoint: x, y, z of the eye, in the unit of the clouds; None = that of each cloud, where its sensor stood.
        frame: the frame that the viewpoint is given in.
        radius_factor: larger ones hide less, see :func:`~pcdata.functional.hidden_point_mask`.

    Raises:
        FrameError: no viewpoint is given, and the clouds have none of their own, or one for each point.
    """

    viewpoint: Vec3 | None = None
    frame: Name | None = None
    radius_factor: Annotated[float, Ge(1)] = 100.0

    def check_fields(self) -> None:
        """A viewpoint is given in a frame."""
        if (self.viewpoint is None) != (self.frame is None):
            raise ConfigError("RemoveHiddenPoints: give a viewpoint and its frame, or neither")

    def frame_needed(self) -> str | None:
        """The frame of the viewpoint."""
        return self.frame

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Pick the rows that nothing hides."""
        eye: Tensor | Vec3 | None = self.viewpoint if self.viewpoint is not None else cloud.viewpoint
        if eye is None:
            raise FrameError(
                "RemoveHiddenPoints: needs the viewpoint of each cloud, where its sensor stood; set "
                "PointCloud.viewpoint, give viewpoint and frame, or put it before MergeViews"
            )
        keep = ~hidden_point_mask(cloud.points, cloud.ptr, viewpoint=eye, radius_factor=self.radius_factor)
        return keep, ptr_after_mask(keep, cloud.ptr)
