"""Depth that is smoothed within windows of pixels: never across an edge, and never into a hole."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count, checked_positive
from pcdata.functional.depth.pixel_sort import pick_image, sort_images

MAX_REACH = 7  # pixels: windows of 15 x 15
MAX_MEDIAN_REACH = 3  # 49 values sorted at every pixel


@op(
    depth="V H W : depth",
    reach=partial(checked_count, maximum=MAX_REACH),
    sigma_pixels=checked_positive,
    sigma_depth=checked_positive,
    max_jump=partial(checked_positive, finite=False),
)
def bilateral_filter(
    depth: Tensor,  # (V, H, W) float32 metres, 0 = no reading
    *,
    reach: int = 2,
    sigma_pixels: float = 1.5,
    sigma_depth: float = 0.01,
    max_jump: float = 0.02,
    backend: str = "auto",
) -> Tensor:  # (V, H, W) float32 metres
    """Average readings with those around them that are near in the image and in depth.

    A reading p takes the mean of the readings q of the square window of ``2 * reach + 1`` pixels around it that lie on
    its own surface (their depths differ by at most ``max_jump`` times the nearer one), weighted by
    exp(-|p - q|^2 / (2 sigma_pixels^2)) exp(-(z_p - z_q)^2 / (2 sigma_depth^2)). Beyond an edge nothing weighs at all,
    holes stay holes and weigh nothing, and beyond the image there is nothing. Gradients flow through values and
    weights.

    Args:
        depth: the images.
        reach: pixels to each side.
        sigma_pixels: in pixels.
        sigma_depth: metres.
        max_jump: as a part of the depth; infinity leaves edges to ``sigma_depth`` alone.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ConfigError: a parameter out of range.
        CaptureError: a negative depth.

    Source: Tomasi & Manduchi, Bilateral filtering for gray and color images, ICCV 1998.
    """
    # Differences from the pixel itself: what is averaged is small, so float32 loses nothing of the depth.
    total, weight = torch.zeros_like(depth), torch.zeros_like(depth)
    scale, shares = depth_scale(sigma_depth), iter(pixel_shares(reach, sigma_pixels))
    for other in _around(depth, reach):
        near, of_place = _on_one_surface(depth, other, max_jump), next(shares)
        offset = torch.where(near, other - depth, 0.0)
        scaled = offset * scale
        share = torch.where(near, _power_of_two(-(scaled * scaled)) * of_place, 0.0)
        total, weight = total + share * offset, weight + share
    there = depth > 0
    return torch.where(there, depth + total / torch.where(there, weight, 1.0), 0.0)


def depth_scale(sigma: float) -> float:
    """Return the factor of differences in depth whose negative square is the exponent of 2; finite in float32."""
    return min(math.sqrt(0.5 / math.log(2)) / sigma, 1e19)


def pixel_shares(reach: int, sigma: float) -> list[float]:
    """Return how much the pixels of a window count for their distance in the image, row by row."""
    steps = range(-reach, reach + 1)
    rate = min(0.5 / sigma / sigma, 1e38)
    return [math.exp(-(row * row + column * column) * rate) for row in steps for column in steps]


# Of 2^x - 1 from -1/2 to 1/2, divided by x: the least largest relative error of 2^x in double precision, 8.5e-8.
_POWER = (0.6931468844413757, 0.24022223055362701, 0.055507998913526535, 0.009672367945313454, 0.0013253462966531515)
_LEAST_EXPONENT = -100.0  # weighs nothing any more, but is no denormal number


def _power_of_two(exponent: Tensor) -> Tensor:
    """Return 2 to the power of float32 exponents up to 0, to 2e-7; 1 for 0, and the same bits on every machine."""
    exponent = exponent.clamp(min=_LEAST_EXPONENT)
    whole = exponent.detach().round()
    rest = exponent - whole
    value = torch.full_like(rest, _POWER[-1])
    for coefficient in (*_POWER[-2::-1], 1.0):
        value = value * rest + coefficient
    return value * ((whole.to(torch.int32) + 127) << 23).view(torch.float32)


@op(
    depth="V H W : depth",
    reach=partial(checked_count, maximum=MAX_MEDIAN_REACH),
    max_jump=partial(checked_positive, finite=False),
)
def median_filter(
    depth: Tensor,  # (V, H, W) float32 metres, 0 = no reading
    *,
    reach: int = 1,
    max_jump: float | None = None,
    backend: str = "auto",
) -> Tensor:  # (V, H, W) float32 metres
    """Replace every reading by the median reading of the square window of ``2 * reach + 1`` pixels around it.

    Holes stay holes and take no part, nor does what lies beyond the image. Of an even number the nearer of the middle
    two is taken, so every value is one that was measured in the window. Lone readings off their surroundings go; with
    ``max_jump`` only readings on the pixel's own surface are looked at (their depths differ by at most this part of the
    nearer one), which keeps thin things and corners, and lone readings too. The gradient goes to the reading that was
    taken.

    Args:
        depth: the images.
        reach: pixels to each side.
        max_jump: as a part of the depth; None = all readings of the window.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ConfigError: a parameter out of range.
        CaptureError: a negative depth.

    Source: Tukey, Exploratory data analysis, 1977; in images Huang et al., A fast two-dimensional median filtering
    algorithm, IEEE TASSP 27(1), 1979.
    """
    values = depth.detach()
    offered = []
    count = torch.zeros_like(values, dtype=torch.int64)
    for other in _around(values, reach):
        near = other > 0 if max_jump is None else _on_one_surface(values, other, max_jump)
        offered.append(torch.where(near, other, torch.inf))
        count += near
    median = pick_image(sort_images(offered), (count - 1).clamp(min=0) // 2)
    median = torch.where(values > 0, median, 0.0)
    if not (torch.is_grad_enabled() and depth.requires_grad):
        return median
    found, taken = torch.zeros_like(depth), values == 0
    for other, value in zip(_around(depth, reach), offered):
        here = ~taken & (value == median)
        found, taken = torch.where(here, other, found), taken | here
    return found


def _around(depth: Tensor, reach: int) -> Iterator[Tensor]:
    """Yield for every pixel of a window, row by row, the image (V, H, W) of the pixels there; 0 beyond the image."""
    height, width = depth.shape[1:]
    padded = torch.nn.functional.pad(depth, (reach,) * 4)
    for row in range(2 * reach + 1):
        for column in range(2 * reach + 1):
            yield padded[:, row : row + height, column : column + width]


def _on_one_surface(depth: Tensor, other: Tensor, max_jump: float) -> Tensor:
    """Say where both images have readings that differ by at most this part of the nearer one."""
    nearer = torch.minimum(depth, other)
    return (nearer > 0) & ((depth - other).abs() <= max_jump * nearer)
