"""The camera that a CameraInfo describes: its lens, and the part of the sensor that the image shows.

Source: sensor_msgs/CameraInfo: matrices are of the whole sensor; a region of interest is cut from it, then binned.
"""

from __future__ import annotations

import math
from typing import Any

import torch

from pcdata.errors import IntrinsicsError, PcdataError
from pcdata.io.calibration.stated_lens import lens_of
from pcdata.structures import Camera

SAY_INTRINSICS = "say intrinsics=(fx, fy, cx, cy) in pixels (--intrinsics FX FY CX CY)"


def camera_of(
    where: str,
    info: Any,
    size: tuple[int, int],
    *,
    rectified: bool = False,
    is_window: bool = False,
    how: str = SAY_INTRINSICS,
) -> Camera:
    """Return the camera of an image.

    Args:
        where: for messages.
        info: a CameraInfo, or Foxglove's CameraCalibration.
        size: of the image, (height, width).
        rectified: the image is undistorted already, so the projection matrix is of it and no lens.
        is_window: cut from a larger image, so the principal point may lie outside.
        how: what helps where it is not calibrated.

    Raises:
        IntrinsicsError: it is not calibrated, of another size, or has a lens of no known model.
    """
    matrix = [float(value) for value in (info.p if hasattr(info, "p") else info.P)] if rectified else _k(info)
    k = [matrix[0], matrix[1], matrix[2], *matrix[3 + rectified : 6 + rectified]]  # a projection has four columns
    fx, skew, cx, below, fy, cy = k
    if fx == 0 or fy == 0:
        raise IntrinsicsError(f"{where} states no focal length: the camera was not calibrated; {how}")
    if not all(map(math.isfinite, k)):
        raise IntrinsicsError(f"{where} states intrinsics that are not finite: the camera was not calibrated; {how}")
    if not info.height or not info.width:
        raise IntrinsicsError(f"{where} is of an image of {info.width}x{info.height} pixels, which is none; {how}")
    lens = None if rectified else lens_of(where, str(info.distortion_model), info.d if hasattr(info, "d") else info.D)
    rows = [[fx, skew, cx], [below, fy, cy], [0.0, 0.0, 1.0]]
    try:
        camera = Camera(
            intrinsics=torch.tensor([rows], dtype=torch.float64, device="cpu"),
            size=(int(info.height), int(info.width)),
            distortion=None if lens is None else torch.tensor([lens], dtype=torch.float64, device="cpu"),
            is_window=is_window,
        )
        camera = _of_region(camera, info)
    except PcdataError as error:
        raise IntrinsicsError(f"{where}: {error}") from error
    if camera.size != size:
        raise IntrinsicsError(
            f"{where} describes an image of {camera.size[1]}x{camera.size[0]} pixels, the image has "
            f"{size[1]}x{size[0]}; name the right topic by camera_info"
        )
    return camera


def _k(info: Any) -> list[float]:
    return [float(value) for value in (info.k if hasattr(info, "k") else info.K)]


def _of_region(camera: Camera, info: Any) -> Camera:
    roi = getattr(info, "roi", None)
    if roi is not None and roi.width and roi.height:
        camera = camera.cropped(int(roi.y_offset), int(roi.x_offset), (int(roi.height), int(roi.width)))
    across, down = (max(1, int(getattr(info, f"binning_{axis}", 0))) for axis in "xy")
    if (across, down) == (1, 1):
        return camera
    # A pixel is the mean of a block, so its center is the block's; a full-sized region is no window of the sensor.
    return camera.resized((max(1, camera.size[0] // down), max(1, camera.size[1] // across)))
