"""The depth images that the rows of a cloud still lie on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from pcdata.contracts.known import is_known, note
from pcdata.functional.image_grid import pixels_rise
from pcdata.structures.structure import Structure

_FEWEST = 100  # points that tell a camera: four numbers are fitted
_PIXELS_OFF = 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageLayout(Structure):
    """The depth images that the clouds of a batch still lie on, row after row in pixel order.

    Args:
        size: (height, width) of every image.
        intrinsics: (B, 3, 3) float64, pixels.
    """

    size: tuple[int, int]
    intrinsics: Tensor


def seen_through_pinhole(
    points: Tensor,  # (N, 3) one cloud
    pixel: Tensor,  # (N,) int64 row * width + column
    size: tuple[int, int],
) -> ImageLayout | None:
    """Return the image that points lie on, its intrinsics told by the points themselves.

    None where they are not the readings of a pinhole camera at the origin that looks along +z: rows that are no pixels,
    a cloud that was moved, a lens that bends by more than a tenth of a pixel.
    """
    wide = points.double()
    z = wide[:, 2]
    if len(wide) < _FEWEST or not bool((z > 0).all()):
        return None
    rows = []
    for axis, place in ((0, pixel % size[1]), (1, pixel // size[1])):
        # place = focal * slope + center, by least squares about the means
        slope, place = wide[:, axis] / z, place.double()
        off, off_place = slope - slope.mean(), place - place.mean()
        focal = float((off * off_place).sum() / (off * off).sum())
        center = float(place.mean() - focal * slope.mean())
        # NaN fails too: points in one column or row
        if not (focal > 0 and bool(((focal * slope + center - place).abs() < _PIXELS_OFF).all())):
            return None
        rows.append((focal, center))
    (fx, cx), (fy, cy) = rows
    intrinsics = torch.tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]], dtype=torch.float64, device=points.device)
    return ImageLayout(size=size, intrinsics=intrinsics)


def within_image(source_index: Tensor, ptr: Tensor, size: tuple[int, int]) -> Tensor:
    """Number pixels within their own image. Rows are in pixel order, so a cloud's last one tells whether they are."""
    num_pixels, rises = size[0] * size[1], pixels_rise(size)
    if is_known(rises, source_index, ptr):
        return source_index
    if source_index.is_cpu:  # elsewhere reading them would wait for the device
        rows = source_index.numpy()
        if all(rows[stop - 1] < num_pixels for start, stop in pairwise(ptr.tolist()) if stop > start):
            return source_index
    within = source_index % num_pixels
    if is_known(pixels_of_views(size), source_index, ptr):
        note(rises, within, ptr)
    return within


def pixels_of_views(size: tuple[int, int]) -> tuple[str, int, int]:
    """Name the fact that source indices, with row pointers, are of pixels of images of this size, in their order."""
    return ("pixels of views", *size)


def joined_layout(layouts: Sequence[ImageLayout | None], clouds: slice = slice(None)) -> ImageLayout | None:
    """Join the layouts of batches, or take part of one; None when one has none or the images differ in size."""
    known = [layout for layout in layouts if layout is not None]
    if len(known) < len(layouts) or len({layout.size for layout in known}) > 1:
        return None
    return ImageLayout(size=known[0].size, intrinsics=torch.cat([layout.intrinsics for layout in known])[clouds])
