"""Fill the holes of a depth image from its neighbors."""

from __future__ import annotations

from functools import partial
from typing import Literal

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.numbers import checked_count, checked_word

RULES = ("left", "farthest", "nearest")


@op(depth="V H W : depth", rule=partial(checked_word, words=RULES), max_size=checked_count)
def fill_holes(
    depth: Tensor,  # (V, H, W) float32, 0 = no reading
    *,
    rule: Literal["left", "farthest", "nearest"] = "farthest",
    max_size: int | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # depth (V, H, W); distance (V, H, W) int64, pixels to the reading that was copied
    """Give pixels without a reading the depth of a reading beside them; readings stay as they are.

    ``left`` copies the next reading to the left in the row. The others go inwards from the rim of a hole, a layer of
    pixels at a time: each pixel takes, of those of its four neighbors that have a depth by then, the farthest
    (background, the safe guess in a stereo shadow) or the nearest. Nothing is blended. ``distance`` counts the columns
    or the layers from the reading; 0 = not filled. A pixel that no reading leads to stays empty.

    With ``max_size`` only narrow places are filled: a pixel is left empty if a square of ``max_size + 1`` pixels a side
    that holds no reading fits over it within the image.

    Raises:
        ConfigError: an unknown rule or a size below 1.
        CaptureError: a negative depth.

    Source: librealsense, hole filling filter; it goes through the image line by line, in place, so there values run
    further downwards and to the right than upwards.
    """
    hole = depth == 0
    wanted = hole if max_size is None else hole & ~wide_holes(hole, max_size + 1)
    if rule == "left":
        return _fill_from_left(depth, wanted)
    return _fill_inwards(depth, wanted, farthest=rule == "farthest")


@inner
def filled_images(
    depth: Tensor, rule: Literal["left", "farthest", "nearest"], max_size: int | None, max_distance: int
) -> tuple[Tensor, Tensor]:
    """Return what :func:`fill_holes` gives, and where (V, H, W) the distance is above a limit, instead of it."""
    filled, distance = fill_holes(depth, rule=rule, max_size=max_size)
    return filled, distance > max_distance


@inner
def fill_rows(values: Tensor, radius: int) -> Tensor:
    """Fill up to ``radius`` pixels of every gap in a row from its left side, then as many from its right side.

    Args:
        values: (V, H, W) float32, 0 = no reading.
        radius: pixels per side.

    Source: librealsense, hole filling mode of the spatial filter.
    """
    for flip in (False, True):
        image = values.flip(-1) if flip else values
        filled, distance = _fill_from_left(image, image == 0)
        image = torch.where(distance <= radius, filled, image)
        values = image.flip(-1) if flip else image
    return values


def _fill_from_left(depth: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Copy the last reading of the row into wanted pixels that only wanted pixels separate from it."""
    width = depth.shape[2]
    flat, holes = depth.flatten(), wanted.flatten().nonzero().squeeze(1)
    stops = (~wanted).flatten()  # readings, and holes to leave: none can be passed
    stop_pixels = stops.nonzero().squeeze(1)
    rank = stops.cumsum(0)[holes] - 1
    has_stop = rank >= 0
    holes, rank = holes[has_stop], rank[has_stop]
    source = stop_pixels[rank]
    same_row = source.div(width, rounding_mode="floor") == holes.div(width, rounding_mode="floor")
    reached = same_row & (flat[source] > 0)
    holes, source = holes[reached], source[reached]
    filled = flat.scatter(0, holes, flat[source])
    distance = torch.zeros_like(flat, dtype=torch.int64).scatter_(0, holes, holes - source)
    return filled.reshape(depth.shape), distance.reshape(depth.shape)


def _fill_inwards(depth: Tensor, wanted: Tensor, *, farthest: bool) -> tuple[Tensor, Tensor]:
    """Fill layer after layer; each step touches only the pixels of its layer, so time follows the pixels filled."""
    views, height, width = depth.shape
    # A border without depth spares every look beyond the image.
    values = torch.nn.functional.pad(depth, (1, 1, 1, 1)).flatten()
    waiting = torch.nn.functional.pad(wanted, (1, 1, 1, 1)).flatten()
    distance = torch.zeros_like(values, dtype=torch.int64)
    around = torch.tensor([[-width - 2], [-1], [1], [width + 2]], dtype=torch.int64, device=depth.device)
    layer = waiting.nonzero().squeeze(1)
    layer = layer[(values[layer + around] > 0).any(0)]
    step = 0
    while len(layer):
        step += 1
        near = layer + around
        offered = values[near]
        if farthest:
            chosen = offered.amax(0)
        else:
            chosen = torch.where(offered > 0, offered, torch.inf).amin(0)
        values[layer] = chosen
        distance[layer] = step
        waiting[layer] = False
        candidates = near[waiting[near]]
        # Several neighbors lead to one pixel: the last to sign for it keeps it.
        distance[candidates] = ticket = torch.arange(len(candidates), dtype=torch.int64, device=depth.device)
        layer = candidates[distance[candidates] == ticket]
    return tuple(  # type: ignore[return-value]
        image.reshape(views, height + 2, width + 2)[:, 1:-1, 1:-1].contiguous() for image in (values, distance)
    )


def wide_holes(hole: Tensor, side: int) -> Tensor:
    """Mark the pixels over which a square of ``side`` pixels that is all hole fits within the image: an opening."""
    height, width = hole.shape[1:]
    if side > height or side > width:
        return torch.zeros_like(hole)
    # Counts of holes per square from a summed table: exact, and as fast for large squares as for small ones.
    empty = _box_sum(hole, side) == side * side
    padded = torch.nn.functional.pad(empty, (side - 1,) * 4)
    return _box_sum(padded, side) > 0


def _box_sum(mask: Tensor, side: int) -> Tensor:
    """Return for every square of ``side`` pixels how many are set, (V, H - side + 1, W - side + 1) int32."""
    table = torch.nn.functional.pad(mask.cumsum(1, dtype=torch.int32).cumsum(2, dtype=torch.int32), (1, 0, 1, 0))
    rows = table[:, side:] - table[:, :-side]
    return rows[:, :, side:] - rows[:, :, :-side]
