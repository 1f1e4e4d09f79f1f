"""Pictures of depth images as PNG, without matplotlib: a page has many, and they must be small."""

from __future__ import annotations

import base64
import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pcdata.structures import DepthFrame

WIDTH = 320  # pixels that a picture is reduced to
# Viridis at nine places (van der Walt and Smith 2015), as the viewer has it.
_VIRIDIS = np.array(
    [
        *([68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141]),
        *([39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]),
    ],
    dtype=np.float64,
)
NO_READING = (214, 64, 159)  # not in viridis
_LEVEL = 5  # of zlib: a third less time than its usual 6, for at most 3 % more bytes (real and made captures)
_STEP = 0.03  # of the depth: neighbors farther apart are two surfaces, as in Kinect-like sensors up to some metres


def depth_picture(frame: DepthFrame, view: int, width: int = WIDTH) -> bytes:
    """Depth from near (dark) to far (bright), pixels without a reading in magenta; as a PNG.

    The colors are even in 1/depth, as the precision of stereo is: a far wall does not take them from the table.
    """
    depth = _reduced(frame.depth[view].cpu().numpy(), width)
    valid = depth > 0
    inverse = 1 / np.where(valid, depth, 1.0)
    far, near = np.quantile(inverse[valid], [0.01, 0.99]) if valid.any() else (0.0, 1.0)
    return _ramp_png((near - inverse) / max(near - far, 1e-9), valid)


def confidence_picture(frame: DepthFrame, view: int, width: int = WIDTH) -> bytes | None:
    """Confidence from low (dark) to high, None where the capture has none."""
    if frame.confidence is None:
        return None
    confidence = _reduced(frame.confidence[view].cpu().numpy().astype(np.float64), width)
    return _ramp_png(confidence / max(float(confidence.max()), 1e-9), np.ones(confidence.shape, dtype=bool))


def edges_picture(frame: DepthFrame, view: int, width: int = WIDTH) -> bytes | None:
    """The color image with the rims of depth in red: they lie on the outlines of things where both are registered."""
    if frame.colors is None:
        return None
    depth = _reduced(frame.depth[view].cpu().numpy(), width)
    image = _reduced(frame.colors[view].cpu().numpy(), width).copy()
    image[rims(depth)] = (255, 40, 40)
    return png(image)


def color_picture(frame: DepthFrame, view: int, width: int = WIDTH) -> bytes | None:
    """The color image, None where the capture has none."""
    return None if frame.colors is None else png(_reduced(frame.colors[view].cpu().numpy(), width))


def rims(depth: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the near side of steps of depth, (H, W)."""
    rim = np.zeros(depth.shape, dtype=bool)
    for axis in (0, 1):
        first = depth[:-1] if axis == 0 else depth[:, :-1]
        second = depth[1:] if axis == 0 else depth[:, 1:]
        both = (first > 0) & (second > 0)
        step = np.where(both, second - first, 0) / np.maximum(np.minimum(first, second), 1e-9)
        low, high = (rim[:-1], rim[1:]) if axis == 0 else (rim[:, :-1], rim[:, 1:])
        low |= step > _STEP
        high |= step < -_STEP
    return rim


def viridis(share: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return colors (..., 3) for numbers in 0..1."""
    place = np.clip(np.nan_to_num(share), 0, 1) * (len(_VIRIDIS) - 1)
    low = np.minimum(place.astype(int), len(_VIRIDIS) - 2)
    return np.asarray(_VIRIDIS[low] + (place - low)[..., None] * (_VIRIDIS[low + 1] - _VIRIDIS[low])).astype(np.uint8)


def png(image: NDArray[np.uint8]) -> bytes:
    """Return an image (H, W, 3) as the bytes of a PNG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="png", compress_level=_LEVEL)
    return buffer.getvalue()


def _ramp_png(share: NDArray[np.floating], there: NDArray[np.bool_]) -> bytes:
    """Return numbers in 0..1 in 255 colors, and one more where there are none: a third of the bytes of full colors."""
    levels = np.where(there, 1 + np.clip(np.nan_to_num(share), 0, 1) * 254, 0).astype(np.uint8)
    image = Image.fromarray(levels)
    image.putpalette(np.vstack([np.array([NO_READING], np.uint8), viridis(np.linspace(0, 1, 255))]).tobytes())
    buffer = io.BytesIO()
    image.save(buffer, format="png", compress_level=_LEVEL)
    return buffer.getvalue()


def png_uri(picture: bytes) -> str:
    """Return a PNG as a data URI."""
    return "data:image/png;base64," + base64.b64encode(picture).decode("ascii")


def _reduced(image: NDArray, width: int) -> NDArray:
    """Keep every k-th pixel: depth is never averaged."""
    stride = max(1, -(-image.shape[1] // max(width, 1)))
    return image[::stride, ::stride]
