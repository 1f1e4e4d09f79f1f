"""The rays of depth pixels as the compiled core takes them."""

from __future__ import annotations

import functools

from torch import Tensor

from pcdata.functional.depth.deproject import pixel_rays

# x/z of every column (V, W) and y/z of every row (V, H), or both of every pixel (V, H, W, 2); float32.
Rays = tuple[Tensor | None, Tensor | None, Tensor | None]


def rays_of_cameras(intrinsics: Tensor, size: tuple[int, int], distortion: Tensor | None) -> Rays:
    """Return the rays of columns and rows where they say all, else those of every pixel, kept for the next call."""
    crossed = None if distortion is not None else _crossed_rays(intrinsics, size)
    if crossed is not None:
        return (*crossed, None)
    return None, None, _cached_rays(_Key(intrinsics), size, None if distortion is None else _Key(distortion))


def _crossed_rays(intrinsics: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor] | None:
    """Return x/z of every column (V, W) and y/z of every row (V, H); None if a skew makes x depend on the row."""
    if bool((intrinsics[:, 0, 1] != 0).any()):
        return None
    top = pixel_rays(intrinsics, (1, size[1]))[:, 0, :, 0]
    left = pixel_rays(intrinsics, (size[0], 1))[:, :, 0, 1]
    # An infinite y would make x NaN in the reference.
    return (top.float(), left.float()) if bool(left.isfinite().all()) else None


class _Key:
    """A small tensor that a cache can look up by value."""

    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor.detach().clone()
        self.value = tensor.dtype, tuple(tensor.shape), tuple(tensor.flatten().tolist())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self.value == other.value

    def __hash__(self) -> int:
        return hash(self.value)


@functools.lru_cache(maxsize=4)  # 7 MB each at 1280x720: one per camera of a usual rig
def _cached_rays(intrinsics: _Key, size: tuple[int, int], distortion: _Key | None) -> Tensor:
    return pixel_rays(intrinsics.tensor, size, None if distortion is None else distortion.tensor).float().contiguous()
