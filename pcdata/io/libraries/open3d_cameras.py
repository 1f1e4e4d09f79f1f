"""Cameras, poses and captures <-> Open3D's: its camera axes and its centers of pixels are ours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from pcdata.errors import DTypeError, IntrinsicsError, ShapeError
from pcdata.geometry import rigid
from pcdata.io.libraries.open3d_clouds import open3d, to_library
from pcdata.io.libraries.rows import check_texts
from pcdata.structures import Camera, DepthFrame


class Open3DView(NamedTuple):
    """One view of a capture, in the order that ``volume.integrate(*view)`` and ``create_from_rgbd_image(*view)`` take.

    Depth is float32 metres: where a function of Open3D asks for ``depth_scale``, it is 1.
    """

    image: Any  # RGBDImage; without colors its color is empty
    intrinsic: Any  # camera.PinholeCameraIntrinsic, or core.Tensor (3, 3) float64
    extrinsic: Any  # camera_from_world, (4, 4) float64: np.ndarray or core.Tensor; the identity where no pose is known


class PosedCamera(NamedTuple):
    """Cameras and where they stood."""

    camera: Camera  # V cameras
    world_from_camera: Tensor  # (V, 4, 4) float64


def intrinsics_to_open3d(where: str, camera: Camera) -> list[Any]:
    """Return ``camera.PinholeCameraIntrinsic`` of every view.

    Raises:
        IntrinsicsError: a lens or skewed axes, which Open3D does not have.
    """
    if camera.distortion is not None:
        raise IntrinsicsError(
            f"{where}: Open3D has no lenses; pcdata.Undistort()(frame) gives images of a pinhole camera"
        )
    if bool((camera.intrinsics[:, 0, 1] != 0).any()):
        raise IntrinsicsError(f"{where}: the axes are skewed, which Open3D does not have; resample the images first")
    made = open3d().camera.PinholeCameraIntrinsic
    height, width = camera.size
    return [made(width, height, k[0][0], k[1][1], k[0][2], k[1][2]) for k in camera.intrinsics.tolist()]


def frame_to_open3d(
    where: str, frame: DepthFrame, legacy: bool, fields: Sequence[str] | None, copy: bool
) -> list[Open3DView]:
    """Return every view of a capture."""
    library = open3d()
    there = [name for name in ("colors", "labels", "confidence", "mask") if getattr(frame, name) is not None]
    check_texts(where, "fields", fields)
    if not {*(fields or ())} <= {*there}:
        raise DTypeError(f"{where}: fields must be names of what the capture has, {there}, got {fields!r}")
    chosen = there if fields is None else [name for name in there if name in fields]
    if strange := [name for name in chosen if name != "colors"]:
        raise DTypeError(
            f"{where}: images of Open3D have no place for {', '.join(strange)}; say what is handed over: fields="
            f"{('colors',) if 'colors' in there else ()}"
        )
    intrinsics = intrinsics_to_open3d(where, frame.camera)
    poses = frame.world_from_camera
    extrinsics = (
        np.eye(4)[None].repeat(frame.num_views, 0) if poses is None else rigid.invert_rigid(poses).cpu().numpy()
    )
    views = []
    for view, (intrinsic, extrinsic) in enumerate(zip(intrinsics, extrinsics, strict=True)):
        depth = frame.depth[view]
        colors = frame.colors[view] if "colors" in chosen and frame.colors is not None else None
        if legacy:
            image = library.geometry.RGBDImage()
            image.depth = library.geometry.Image(depth.cpu().numpy().copy())
            if colors is not None:
                image.color = library.geometry.Image(colors.cpu().numpy().copy())
            views.append(Open3DView(image, intrinsic, np.array(extrinsic)))
            continue
        image = library.t.geometry.RGBDImage()
        image.depth = library.t.geometry.Image(to_library(where, depth[..., None], copy))
        if colors is not None:
            image.color = library.t.geometry.Image(to_library(where, colors, copy))
        matrix = library.core.Tensor(np.array(intrinsic.intrinsic_matrix))
        views.append(Open3DView(image, matrix, library.core.Tensor(np.array(extrinsic))))
    return views


def camera_of_open3d(intrinsics: Sequence[Any]) -> Camera:
    """Return the cameras of ``PinholeCameraIntrinsic``.

    Raises:
        ShapeError: images of several sizes, or of none.
        IntrinsicsError: numbers that cannot be the intrinsics of this image.
    """
    sizes = {(one.height, one.width) for one in intrinsics}
    if len(sizes) != 1 or min(min(sizes)) < 1:
        raise ShapeError(f"from_open3d: cameras must have one image size (height, width), got {sorted(sizes)}")
    matrices = np.stack([np.asarray(one.intrinsic_matrix, dtype=np.float64) for one in intrinsics])
    return Camera(intrinsics=torch.from_numpy(matrices), size=sizes.pop())


def posed_of_open3d(parameters: Sequence[Any]) -> PosedCamera:
    """Return cameras and poses of ``PinholeCameraParameters``.

    Raises:
        ShapeError: none, or images of several sizes.
        PoseError: an extrinsic that is not rigid.
    """
    if not parameters:
        raise ShapeError("from_open3d: the trajectory has no cameras")
    extrinsics = torch.from_numpy(np.stack([np.asarray(one.extrinsic, dtype=np.float64) for one in parameters]))
    rigid.check_rigid("from_open3d: extrinsic", extrinsics)
    return PosedCamera(camera_of_open3d([one.intrinsic for one in parameters]), rigid.invert_rigid(extrinsics))
