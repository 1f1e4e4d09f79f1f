"""What of a table things seem to enclose: the floors of bowls, pots and trays."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from pcdata.contracts.on_host import bounds_of
from pcdata.functional.image_clusters import linked_pixels
from pcdata.functional.image_grid import ImageGrid, is_lined

# Part of the border of a floor over which the wall rises from it; the rest may be hidden by a rim in front. The table
# that is seen through a handle meets it only where the handle's foot is near.
_LEAST_WALL = 0.25


def enclosed_points(
    something: Tensor,  # (N,) bool
    rise: Tensor,  # (N,) height over the table
    foot: float,
    ptr: Tensor,
    grid: ImageGrid,
    *,
    backend: str = "auto",
) -> Tensor:  # (N,) bool
    """Mark points that what stands on a table encloses on the image, and from which it rises.

    A table is seen around what stands on it. A patch that is nowhere connected to it, over pixels of the table and such
    without a point, is the floor of something hollow, even where it is too low to be told from the table by height.
    That something rises from it, on a quarter of the border at least, parts it from a table that is seen through a
    handle. The floor of a bin may come in pieces too: nothing is marked where the table itself is enclosed, or what
    encloses a patch goes on beyond the image.

    Args:
        something: the points that stand on the table.
        rise: of every point.
        foot: what is lower than this, beside a patch, rises from it; what is higher is in front of it.
        ptr: row pointers.
        grid: the depth image that the points lie on.
        backend: which body finds connected pixels.
    """
    enclosed = torch.zeros_like(something)
    for start, stop in pairwise(bounds_of(ptr)):
        own, pixel = something[start:stop], grid.pixel_index[start:stop]
        if not bool(own.any()):
            continue
        wall = _framed(own, pixel, grid.size)
        if is_lined(pixel, grid.size):
            wall[1:-1, 1:-1] = (max_pool2d(wall[None].float(), 3, stride=1, padding=1)[0] > 0)[1:-1, 1:-1]
        window = _window(wall)
        part = _parts(~wall[window], backend)
        row, column = ((part != part[0, 0]) & ~wall[window]).nonzero().unbind(1)
        if not len(row):
            continue
        number = part[row, column]
        edge = _at_edge(wall, backend)
        row, column = row + (window[0].start - 1), column + (window[1].start - 1)
        found = _floors(row, column, number, own, rise[start:stop], foot, pixel, edge)
        enclosed[start:stop][found] = True
    return enclosed


def _floors(
    row: Tensor,  # (M,) of pixels that are enclosed
    column: Tensor,
    number: Tensor,  # (M,) of the patch of each
    something: Tensor,
    rise: Tensor,
    foot: float,
    pixel: Tensor,
    edge: Tensor,  # (H, W) bool: what stands there goes on beyond the image
) -> Tensor:  # rows of points of patches that are floors
    """Tell floors of hollow things from what is seen through handles."""
    width = edge.shape[1]
    own = _rows(row, column, pixel, width)
    there = own >= 0
    there &= ~something[own]
    row, column, number, own = row[there], column[there], number[there], own[there]
    # Where the table itself is enclosed, its pieces are no floors.
    sizes = torch.bincount(number)
    if not len(own) or int(sizes.max()) > int((~something).sum()) - len(own):
        return own[:0]
    border, walls, cut = (sizes.new_zeros(len(sizes)) for _ in range(3))
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        beside = _rows(row + down, column + right, pixel, width)
        stands = (beside >= 0) & something[beside]
        border += torch.bincount(number[stands], minlength=len(sizes))
        walls += torch.bincount(number[stands & (rise[beside] < foot)], minlength=len(sizes))
        cut += torch.bincount(number[stands & edge.flatten()[pixel[beside]]], minlength=len(sizes))
    return own[((border > 0) & (walls >= _LEAST_WALL * border) & (cut == 0))[number]]


def _at_edge(wall: Tensor, backend: str) -> Tensor:
    """Mark what is connected to the edge of the image, given with a margin of one pixel, which is left out."""
    part = _parts(wall, backend)[1:-1, 1:-1]
    touching = torch.cat([part[0], part[-1], part[:, 0], part[:, -1]]).unique()
    return torch.isin(part, touching[touching >= 0])


def _rows(row: Tensor, column: Tensor, pixel: Tensor, width: int) -> Tensor:
    """Return the rows of the points on pixels, -1 where there is none; ``pixel`` rises."""
    wanted = row * width + column
    place = torch.searchsorted(pixel, wanted).clamp(max=len(pixel) - 1)
    inside = (column >= 0) & (column < width)
    return torch.where(inside & (pixel[place] == wanted), place, -1)


def _framed(mask: Tensor, pixel: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the image of a mask of points, with a margin of one pixel."""
    height, width = size
    image = torch.zeros(height * width, dtype=torch.bool, device=mask.device)
    image[pixel] = mask
    return torch.nn.functional.pad(image.reshape(size), (1, 1, 1, 1))


def _window(mask: Tensor) -> tuple[slice, slice]:
    """Return rows and columns that hold all of a mask whose border is empty, and one pixel around it."""
    lines = []
    for along in (1, 0):
        there = mask.any(along).nonzero()[:, 0]
        lines.append(slice(int(there[0]) - 1, int(there[-1]) + 2))
    return lines[0], lines[1]


def _parts(mask: Tensor, backend: str) -> Tensor:
    """Number the connected parts of a mask (H, W), over corners too; -1 elsewhere."""
    pixel = mask.flatten().nonzero()[:, 0]
    width = mask.shape[1]
    points = torch.stack([pixel // width, pixel % width, torch.zeros_like(pixel)], dim=1).float()
    ptr = torch.tensor([0, len(pixel)], dtype=torch.int64, device=mask.device)
    part = torch.full((mask.numel(),), -1, dtype=torch.int64, device=mask.device)
    part[pixel] = linked_pixels(points, ptr, pixel, (mask.shape[0], width), 1.5, 1, backend=backend)
    return part.reshape(mask.shape)
