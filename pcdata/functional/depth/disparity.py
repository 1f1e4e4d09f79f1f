"""Disparity of stereo cameras, and the edge-preserving filter that belongs into it."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.numbers import checked_count, checked_fraction, checked_positive
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ConfigError

# librealsense counts disparity in 1/32 pixel, the step of its matcher; its thresholds are in this unit.
STEPS_PER_PIXEL = 32

# Holes during the filter: so far from any disparity that no step to or from them is small, yet finite, because the
# recursion multiplies what it does not use by zero, and zero times infinity would be NaN.
LINE_HOLE = -1e30
_LARGEST_STEP = 1e29  # so it is for thresholds up to infinity


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


@inner
def smoothed_images(values: Tensor, scale: Tensor | None, alpha: float, delta: float, iterations: int) -> Tensor:
    """Return values filtered as :func:`spatial_filter` says.

    Args:
        values: (V, H, W) float32, 0 = no reading; none negative.
        scale: (V,) float32: values are depths; ``scale / depth`` is filtered and turned back. None = they are as they
            are.
        alpha: as there.
        delta: as there.
        iterations: as there.
    """
    if scale is not None:
        disparity = smoothed_images(reciprocals(values, scale), None, alpha, delta, iterations)
        return reciprocals(disparity, scale)
    # The axis gone along comes first, so that every step reads and writes contiguous memory.
    rows = torch.where(values > 0, values, LINE_HOLE).permute(1, 0, 2).contiguous()  # (H, V, W)
    columns = torch.empty_like(rows.permute(2, 1, 0), memory_format=torch.contiguous_format)  # (W, V, H)
    for _ in range(iterations):
        columns.copy_(rows.permute(2, 1, 0))
        _smooth_forth_and_back(columns, 1 - alpha, smallest_edge(delta))
        rows.copy_(columns.permute(2, 1, 0))
        _smooth_forth_and_back(rows, 1 - alpha, smallest_edge(delta))
    return rows.clamp_(min=0).permute(1, 0, 2).contiguous()


def _smooth_forth_and_back(values: Tensor, keep: float, delta: float) -> None:
    """Average (L, ...) along L in both directions, in place."""
    carried, step = torch.empty_like(values[1:]), torch.empty_like(values[:1]).squeeze(0) if len(values) else values
    slices, weights = values.unbind(0), carried.unbind(0)
    for order in (1, -1):
        # Nothing arrives across an edge; in place, for at this speed a new image costs more than the sums.
        torch.sub(values[1:], values[:-1], out=carried).abs_().lt_(delta).mul_(keep)
        along = slices[::order]
        for previous, current, weight in zip(along, along[1:], weights[::order]):
            # Not lerp_, which rounds once or twice as the processor has it.
            current.add_(torch.sub(previous, current, out=step).mul_(weight))


def smallest_edge(delta: float) -> float:
    """Return the smallest step that is an edge such that every step to or from a hole is one."""
    return min(delta, _LARGEST_STEP)


@inner
def reciprocals(values: Tensor, scale: Tensor) -> Tensor:
    """Return ``scale / value`` of images (V, H, W) with a scale (V,) float32 each; 0 stays 0."""
    known = values > 0
    return torch.where(known, scale[:, None, None] / torch.where(known, values, 1.0), 0.0)  # 1 / 0 has no gradient


def disparity_scale(focal: Tensor, baseline: float) -> Tensor:
    """Return the (V,) float32 product of depth and disparity: focal lengths (V,) in pixels, baseline in metres."""
    return (STEPS_PER_PIXEL * baseline * focal.double()).float()


@op(
    disparity="V H W : depth",
    alpha=checked_fraction,
    delta=partial(checked_positive, finite=False),
    iterations=checked_count,
    gradient=False,
    steps=(smoothed_images,),
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
    return smoothed_images(disparity, None, alpha, delta, iterations, backend=backend)  # type: ignore[call-arg]


def _reciprocal(where: str, name: str, values: Tensor, focal: Tensor, baseline: float) -> Tensor:
    check_tensors(where, {name: values, "focal": focal}, {name: "V H W : depth", "focal": "V : float"})
    if not (baseline > 0 and bool((focal > 0).all())):
        raise ConfigError(f"{where}: baseline and focal length must be positive, got {baseline} and {focal.tolist()}")
    return reciprocals(values, disparity_scale(focal, baseline))
