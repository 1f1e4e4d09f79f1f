"""The depth images that the rows of a cloud still lie on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.structures.structure import Structure


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageLayout(Structure):
    """The depth images that the clouds of a batch still lie on, row after row in pixel order.

    Args:
        size: (height, width) of every image.
        intrinsics: (B, 3, 3) float64, pixels.
    """

    size: tuple[int, int]
    intrinsics: Tensor


def within_image(source_index: Tensor, ptr: Tensor, num_pixels: int) -> Tensor:
    """Number pixels within their own image. Rows are in pixel order, so a cloud's last one tells whether they are."""
    if source_index.device.type == "cpu":  # elsewhere reading them would wait for the device
        last = ptr[1:][ptr[1:] > ptr[:-1]] - 1
        if bool((source_index[last] < num_pixels).all()):
            return source_index
    return source_index % num_pixels


def joined_layout(layouts: Sequence[ImageLayout | None], clouds: slice = slice(None)) -> ImageLayout | None:
    """Join the layouts of batches, or take part of one; None when one has none or the images differ in size."""
    known = [layout for layout in layouts if layout is not None]
    if len(known) < len(layouts) or len({layout.size for layout in known}) > 1:
        return None
    return ImageLayout(size=known[0].size, intrinsics=torch.cat([layout.intrinsics for layout in known])[clouds])
