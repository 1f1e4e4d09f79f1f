"""The depth image that an organised cloud still lies on."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class ImageGrid:
    """Where each point of a packed batch sits in its view's depth image.

    Operations that take a grid give the same answer without it; it lets a kernel search a window of pixels instead of
    space. That is fast while the points are the back-projection of those pixels, up to a rigid motion that
    ``camera_from_points`` undoes. It is never wrong: kernels prove each window from the points themselves, so a grid
    that does not fit (points denoised, jittered or scaled since, a forgotten motion, a lens that bends the rows) only
    loses the speed. Points that were masked out are no points: leave their pixels out too.
    """

    pixel_index: Tensor  # (N,) int64, v * width + u within the cloud's own image, increasing within a cloud
    size: tuple[int, int]  # (height, width) of every image
    intrinsics: Tensor  # (B, 3, 3) pixels
    camera_from_points: Tensor | None = None  # (B, 4, 4) float, rigid; None = points are in their cameras' frames
