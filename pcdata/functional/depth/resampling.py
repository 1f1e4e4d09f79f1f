"""Depth images of another size, without a depth that nobody measured between two surfaces."""

from __future__ import annotations

from functools import partial
from typing import Literal

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count, checked_image_size, checked_positive, checked_word
from pcdata.errors import ShapeError
from pcdata.functional.depth.pixel_sort import pick_image, sort_images

MAX_FACTOR = 8  # as in librealsense; also what fits the six bits that number the pixels of a block


@op(
    depth="V H W : depth",
    factor=partial(checked_count, maximum=MAX_FACTOR),
    rule=partial(checked_word, words=("median", "mean")),
    max_jump=partial(checked_positive, finite=False),
)
def decimate_depth(
    depth: Tensor,  # (V, H, W) float32 metres, 0 = no reading
    *,
    factor: int,
    rule: Literal["median", "mean"] = "median",
    max_jump: float = 0.02,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # depth (V, h, w) float32 metres; pixel_index (V, h, w) int64
    """Make one pixel of every block of ``factor`` x ``factor`` pixels, from the readings in it alone.

    The median belongs to one surface at any factor: of an even number of readings it is the mean of the middle two if
    they differ by at most ``max_jump`` times the nearer, else the nearer. The mean is what librealsense takes from
    factor 4 on; it smooths more, and mixes the surfaces that meet in a block. Rows and columns that fill no block are
    left out: h = H // factor, w = W // factor.

    ``pixel_index`` is the pixel ``v * W + u`` of the image that the (nearer) median reading comes from, so that labels
    can follow; in a block without a reading, the pixel at its middle (rounded up).

    Raises:
        ConfigError: a factor outside 1..8, an unknown rule or a jump that is not positive.
        ShapeError: the image is smaller than one block.
        CaptureError: a negative depth.

    Source: librealsense, decimation filter (the lower median for 2 and 3, the mean above).
    """
    height, width = depth.shape[1] // factor, depth.shape[2] // factor
    if height == 0 or width == 0:
        raise ShapeError(
            f"decimate_depth: an image of {tuple(depth.shape[1:])} has no block of {factor} x {factor} pixels"
        )
    blocks = [
        depth[:, row : height * factor : factor, column : width * factor : factor]
        for row in range(factor)
        for column in range(factor)
    ]
    count = sum((block > 0).long() for block in blocks)
    assert isinstance(count, Tensor)
    # Floats of one sign are ordered as their bits are, so depth and place sort as one integer: equal depths by place.
    none = torch.iinfo(torch.int64).max
    keys = [
        torch.where(block > 0, (block.contiguous().view(torch.int32).long() << 6) | place, none)
        for place, block in enumerate(blocks)
    ]
    ordered = sort_images(keys)
    median = pick_image(ordered, (count - 1).clamp(min=0) // 2)
    middle = factor // 2 * factor + factor // 2
    place = torch.where(count > 0, median & 63, middle)
    if rule == "median":
        chosen = (median, pick_image(ordered, count // 2))
        if torch.is_grad_enabled() and depth.requires_grad:
            readings = torch.stack(blocks)
            lower, upper = (readings.gather(0, (one & 63).clamp(max=len(blocks) - 1)[None])[0] for one in chosen)
        else:
            lower, upper = ((one >> 6).int().view(torch.float32) for one in chosen)
        # Without the upper one a slanted surface would come out nearer than it is.
        reduced = torch.where(upper - lower <= max_jump * lower, lower + 0.5 * (upper - lower), lower)
    else:
        total = sum(block.double() for block in blocks)
        reduced = (total / count.clamp(min=1)).float()
    rows = torch.arange(height, dtype=torch.int64, device=depth.device)[:, None] * factor + place // factor
    columns = torch.arange(width, dtype=torch.int64, device=depth.device) * factor + place % factor
    return torch.where(count > 0, reduced, 0.0), rows * depth.shape[2] + columns


@op(depth="V H W : depth", size=checked_image_size, max_jump=partial(checked_positive, finite=False))
def resize_depth(
    depth: Tensor,  # (V, H, W) float32 metres, 0 = no reading
    *,
    size: tuple[int, int],  # (height, width)
    max_jump: float | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # depth (V, h, w) float32 metres; pixel_index (V, h, w) int64
    """Sample the depth at the pixel centers of an image of another size.

    Pixel centers are at integers and both images span the same field: new pixel i lies at ``(i + 0.5) H / h - 0.5``,
    as :meth:`pcdata.structures.Camera.resized` has it. Each takes the nearest pixel (``pixel_index``, ``v * W + u``;
    of two equally near ones the lower right), as OpenCV's INTER_NEAREST_EXACT does.

    With ``max_jump``, a new pixel whose four surrounding pixels all have readings that differ by at most this part of
    the nearest one is interpolated between them, linearly in 1 / depth (exact on planes); across an edge or beside a
    hole the nearest pixel still decides, so no depth arises between two surfaces.

    Raises:
        ConfigError: a size below one pixel or a jump that is not positive.
        ShapeError: the image has no pixels.
        CaptureError: a negative depth.
    """
    if 0 in depth.shape[1:]:
        raise ShapeError(f"resize_depth: an image of {tuple(depth.shape[1:])} has no pixels")
    row = _centers(depth.shape[1], size[0], depth.device)
    column = _centers(depth.shape[2], size[1], depth.device)
    index = _nearest(row, depth.shape[1])[:, None] * depth.shape[2] + _nearest(column, depth.shape[2])
    nearest = depth.flatten(1)[:, index.flatten()].reshape(len(depth), *size)
    pixel_index = index.expand(len(depth), -1, -1).contiguous()
    if max_jump is None:
        return nearest, pixel_index
    above, below, down = _between(row, depth.shape[1])
    left, right, across = _between(column, depth.shape[2])
    upper, lower = depth[:, above], depth[:, below]
    corners = [upper[:, :, left], upper[:, :, right], lower[:, :, left], lower[:, :, right]]
    closest = torch.minimum(torch.minimum(corners[0], corners[1]), torch.minimum(corners[2], corners[3]))
    farthest = torch.maximum(torch.maximum(corners[0], corners[1]), torch.maximum(corners[2], corners[3]))
    one_surface = (closest > 0) & (farthest - closest <= max_jump * closest)
    inverse = [1 / torch.where(one_surface, corner, 1.0) for corner in corners]  # 1 / 0 has no gradient
    top, bottom = _mixed(inverse[0], inverse[1], across), _mixed(inverse[2], inverse[3], across)
    return torch.where(one_surface, 1 / _mixed(top, bottom, down[:, None]), nearest), pixel_index


def _mixed(first: Tensor, second: Tensor, part: Tensor) -> Tensor:
    """Go from the first to the second; not by lerp, which rounds once or twice as the processor has it."""
    return first + part * (second - first)


def _centers(old: int, new: int, device: torch.device) -> Tensor:
    """Return where the (new,) pixel centers lie among the old ones, float64."""
    return (torch.arange(new, dtype=torch.float64, device=device) + 0.5) * (old / new) - 0.5


def _nearest(position: Tensor, count: int) -> Tensor:
    return (position + 0.5).floor().long().clamp(0, count - 1)


def _between(position: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pixels on both sides of every position, and how far it is from the first to the second."""
    inside = position.clamp(0, count - 1)
    first = inside.floor().long()
    return first, (first + 1).clamp(max=count - 1), (inside - first).float()
