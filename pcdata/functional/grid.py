"""The depth image that an organised cloud still lies on."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class ImageGrid:
    """Where each point of a packed batch sits in its view's depth image.

    Valid only while the points are exactly the back-projection of those pixels, up to a rigid motion. Operations that
    take a grid give the same answer without it; it lets a kernel search a window of pixels instead of space.
    """

    pixel_index: Tensor  # (N,) int64, v * width + u within the cloud's own image, increasing within a cloud
    size: tuple[int, int]  # (height, width) of every image
    intrinsics: Tensor  # (B, 3, 3) pixels
