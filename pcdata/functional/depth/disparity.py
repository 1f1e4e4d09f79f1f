"""Disparity of stereo cameras, and the edge-preserving filter that belongs into it."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count, checked_fraction, checked_positive
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ConfigError

# librealsense counts disparity in 1/32 pixel, the step of its matcher; its thresholds are in this unit.
STEPS_PER_PIXEL = 32

# Holes during the filter: so far from any disparity that no step to or from them is small, yet finite, because the
# recursion multiplies what it does not use by zero, and zero times infinity would be NaN.
_HOLE = -1e30


def depth_to_disparity(depth: Tensor, focal: Tensor, baseline: float) -> Tensor:
    """Return disparity in 1/32 pixel, ``32 focal baseline / depth``; 0 stays 0.

    Args:
        depth: (V, H, W) float32 metres, 0 = no reading.
        focal: (V,) focal length in pixels of the image that was matched.
        baseline: metres between the two imagers.

    Raises:
        CaptureError: a negative depth.
        ConfigError: a baseline that is not positive.
    """
    return _reciprocal("depth_to_disparity", "depth", depth, focal, baseline)


def disparity_to_depth(disparity: Tensor, focal: Tensor, baseline: float) -> Tensor:
    """Return depth in metres; the inverse of :func:`depth_to_disparity`, up to rounding."""
    return _reciprocal("disparity_to_depth", "disparity", disparity, focal, baseline)


@op(
    disparity="V H W : depth",
    alpha=checked_fraction,
    delta=partial(checked_positive, finite=False),
    iterations=checked_count,
    gradient=False,
)
def spatial_filter(
    disparity: Tensor,  # (V, H, W) float32, 0 = no reading
    *,
    alpha: float = 0.5,
    delta: float = 20.0,
    iterations: int = 2,
    backend: str = "auto",
) -> Tensor:  # (V, H, W) float32
    """Smooth surfaces and keep edges: exponential averages along rows, then columns, forth and back.

    A pixel takes ``alpha`` of its own value and the rest of the average that arrives from its neighbor, but starts
    anew if the neighbor has no reading or differs by ``delta`` or more. It runs step by step along one axis and on
    whole rows at a time across it; time grows with ``iterations`` alone. No gradient flows through it.

    Args:
        disparity: the images; depth works too, but there the noise grows with the square of the distance.
        alpha: weight of the pixel itself, 0..1; 1 changes nothing. librealsense offers 0.25..1.
        delta: the smallest step that is an edge, in the unit of the images. librealsense offers 1..50 (1/32 pixel).
        iterations: how often rows and columns are gone through. librealsense offers 1..5.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ConfigError: a parameter out of range.
        CaptureError: a negative value.

    Source: Gastal & Oliveira, Domain transform for edge-aware image and video processing, 2011, recursive filtering;
    the binary edge is that of librealsense's spatial filter.
    """
    values = disparity.detach()
    # The axis gone along comes first, so that every step reads and writes contiguous memory.
    rows = torch.where(values > 0, values, _HOLE).permute(1, 0, 2).contiguous()  # (H, V, W)
    columns = torch.empty_like(rows.permute(2, 1, 0), memory_format=torch.contiguous_format)  # (W, V, H)
    for _ in range(iterations):
        columns.copy_(rows.permute(2, 1, 0))
        _smooth_forth_and_back(columns, alpha, delta)
        rows.copy_(columns.permute(2, 1, 0))
        _smooth_forth_and_back(rows, alpha, delta)
    return rows.clamp_(min=0).permute(1, 0, 2).contiguous()


def _smooth_forth_and_back(values: Tensor, alpha: float, delta: float) -> None:
    """Average (L, ...) along L in both directions, in place."""
    carried = torch.empty_like(values[1:])
    slices, weights = values.unbind(0), carried.unbind(0)
    for order in (1, -1):
        # 1 - alpha on a surface, 0 across an edge; in place, for at this speed a new image costs more than the sums.
        torch.sub(values[1:], values[:-1], out=carried).abs_().lt_(delta).mul_(1 - alpha)
        along = slices[::order]
        for previous, current, weight in zip(along, along[1:], weights[::order]):
            current.lerp_(previous, weight)


def _reciprocal(where: str, name: str, values: Tensor, focal: Tensor, baseline: float) -> Tensor:
    check_tensors(where, {name: values, "focal": focal}, {name: "V H W : depth", "focal": "V : float"})
    if not (baseline > 0 and bool((focal > 0).all())):
        raise ConfigError(f"{where}: baseline and focal length must be positive, got {baseline} and {focal.tolist()}")
    scale = (STEPS_PER_PIXEL * baseline * focal.double())[:, None, None].float()
    known = values > 0
    return torch.where(known, scale / torch.where(known, values, 1.0), 0.0)  # 1 / 0 has no gradient
