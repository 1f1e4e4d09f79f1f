"""What kernels of depth images ask of their cameras: whether images and cameras fit, and the rays of all pixels.

Rays are kept by the numbers of the cameras and the device: a camera rarely changes from frame to frame.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.on_host import on_host, uploaded
from pcdata.functional.depth.deproject import pixel_rays

# x/z of every column (V, W) and y/z of every row (V, H), or both of every pixel (V, H, W, 2); float32.
Rays = tuple[Tensor | None, Tensor | None, Tensor | None]


def images_fit(
    depth: Tensor,
    intrinsics: Tensor,
    distortion: Tensor | None,
    colors: Tensor | None,
    images: Mapping[str, Tensor],
) -> bool:
    """Whether a kernel may read as many cameras and pixels as there are depths: the callers are not all checked."""
    views = depth.shape[0]
    cameras = intrinsics.shape == (views, 3, 3) and (distortion is None or len(distortion) == views)
    rgb = colors is None or (colors.shape == (*depth.shape, 3) and colors.dtype is torch.uint8)
    return cameras and rgb and all(image.shape[:3] == depth.shape for image in images.values())


def region_fits(depth: Tensor, matrix: Tensor | None, mask: Tensor | None) -> bool:
    """Whether a kernel may read a motion (V, 4, 4) and a mask (V, H, W) of each view."""
    return (mask is None or (mask.shape == depth.shape and mask.dtype is torch.bool)) and (
        matrix is None or matrix.shape == (depth.shape[0], 4, 4)
    )


def depth_limits(near: float | None, far: float | None) -> tuple[float, float]:
    """Return the least and the most depth that is kept."""
    return 0.0 if near is None else float(near), math.inf if far is None else float(far)


class _Key:
    """A small tensor that a cache can look up by value."""

    def __init__(self, tensor: Tensor) -> None:
        array = on_host(tensor).numpy()
        self.value = array.dtype, array.shape, array.tobytes()

    @property
    def tensor(self) -> Tensor:
        """A copy in host memory."""
        dtype, shape, content = self.value
        return torch.from_numpy(np.ndarray(shape, dtype, content).copy())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self.value == other.value

    def __hash__(self) -> int:
        return hash(self.value)


def rays_of_cameras(intrinsics: Tensor, size: tuple[int, int], distortion: Tensor | None) -> Rays:
    """Return the rays of columns and rows where they say all, else those of every pixel, kept for the next call."""
    camera, device = _Key(intrinsics), intrinsics.device
    crossed = None if distortion is not None else _crossed_rays(camera, size, device)
    if crossed is not None:
        return (*crossed, None)
    return None, None, cached_rays(camera, size, None if distortion is None else _Key(distortion), device)


@functools.lru_cache(maxsize=16)  # some kilobytes each
def _crossed_rays(camera: _Key, size: tuple[int, int], device: torch.device) -> tuple[Tensor, Tensor] | None:
    """Return x/z of every column (V, W) and y/z of every row (V, H); None if a skew makes x depend on the row."""
    intrinsics = camera.tensor
    if bool((intrinsics[:, 0, 1] != 0).any()):
        return None
    top = pixel_rays(intrinsics, (1, size[1]))[:, 0, :, 0]
    left = pixel_rays(intrinsics, (size[0], 1))[:, :, 0, 1]
    if not bool(left.isfinite().all()):  # an infinite y would make x NaN in the reference
        return None
    return uploaded(top.float().contiguous(), device), uploaded(left.float().contiguous(), device)


@functools.lru_cache(maxsize=4)  # 7 MB each at 1280x720: one per camera of a usual rig
def cached_rays(intrinsics: _Key, size: tuple[int, int], distortion: _Key | None, device: torch.device) -> Tensor:
    """Return x/z and y/z of every pixel (V, H, W, 2)."""
    lens = None if distortion is None else uploaded(distortion.tensor, device)
    return pixel_rays(uploaded(intrinsics.tensor, device), size, lens).float().contiguous()
