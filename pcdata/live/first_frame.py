"""Whether a frame is like the first one."""

from __future__ import annotations

import math

from pcdata.errors import CaptureError, FrameError, IntrinsicsError, NonFiniteError, ShapeError
from pcdata.io.sources.still_camera import same_camera
from pcdata.structures import DepthFrame

_IMAGES = ("colors", "labels", "mask")  # a confidence may come and go: filters add one


def check_like(frame: DepthFrame, like: DepthFrame) -> None:
    """Require a frame's size, images, cameras and coordinate frame to be those of the first one.

    Raises:
        ShapeError: another size or number of views; an image that is missing, or one more; another device.
        IntrinsicsError: other cameras.
        FrameError: poses that lead to another frame, or none.
    """
    if frame.depth.shape != like.depth.shape:
        (height, width), (rows, columns) = frame.size, like.size
        raise ShapeError(
            f"LivePipeline: the frame has {frame.num_views} views of {width}x{height}, and the first had "
            f"{like.num_views} of {columns}x{rows}; make a pipeline for each stream"
        )
    for name in _IMAGES:
        if (getattr(frame, name) is None) != (getattr(like, name) is None):
            has = "has none" if getattr(frame, name) is None else "has some"
            raise ShapeError(f"LivePipeline: this frame {has} of {name}, unlike the first one")
    if frame.device != like.device:
        raise ShapeError(f"LivePipeline: the frame lies on {frame.device}, and the first on {like.device}")
    if frame.camera is not like.camera and not same_camera(frame.camera, like.camera):
        raise IntrinsicsError(
            "LivePipeline: the frame has other intrinsics, or another lens, than the first; make a pipeline for each "
            "camera"
        )
    if frame.frame_id != like.frame_id:
        raise FrameError(
            f"LivePipeline: the frame's poses lead to {frame.frame_id!r}, and the first one's to {like.frame_id!r}"
        )


def has_readings(least: float, largest: float) -> bool:
    """Say whether a pixel is not 0, given the least and the largest depth.

    Raises:
        NonFiniteError: NaN or infinite depth, which a capture cannot be made with, but changed to.
        CaptureError: negative depth.
    """
    if not math.isfinite(least) or not math.isfinite(largest):
        raise NonFiniteError("LivePipeline: depth has NaN or infinite values; 0 is the only mark for 'no reading'")
    if least < 0:
        raise CaptureError(f"LivePipeline: depth has negative values, down to {least:g} m")
    return largest > 0
