"""How uneven a depth image is, next to how uneven its sensor's noise alone would make it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_WINDOW = 5  # pixels: straight and diagonal edges then reach less than half of a window's second differences
_BAND = 64  # rows at a time: 50 values per pixel are held at once
_MEDIAN_OF_NORMAL = 0.6744897501960817  # the median of |x| for a standard normal x


def depth_roughness(
    depth: Tensor,  # (V, H, W) float64 metres, 0 = no reading
    noise: Tensor,  # (V, H, W) metres: standard deviation of a reading
    edge: Tensor,  # (V, H, W) metres: neighbors that differ by more lie on another surface
) -> Tensor:  # (V, H, W): 1 = as rough as the noise, 0 without a reading, inf = fits no reading around it
    """Return the local noise as a multiple of the expected one.

    Along rows and columns the second difference of 1 / depth is zero on every plane, however tilted, and has sqrt(6)
    times the standard deviation of one value. The estimate is the median of its magnitude over 5 x 5 pixels, which a
    depth edge through the window does not move. A reading that differs by an edge from all its 4-neighbors that read
    gets infinity; with less than half of the window's differences (at corners, among holes) the estimate is 0.

    Source: Immerkaer, Fast noise variance estimation, 1996, for second differences as a measure of noise.
    """
    read = depth > 0
    inverse = torch.where(read, 1.0 / depth.clamp(min=1e-9), 0.0)
    sigma = noise / depth.clamp(min=1e-9).square()  # of 1 / depth
    fits, has_company = torch.zeros_like(read), torch.zeros_like(read)
    bends = []
    for dim in (1, 2):
        sides = [_shifted(depth, shift, dim) for shift in (-1, 1)]
        for side in sides:
            has_company |= side > 0
            fits |= (side > 0) & ((side - depth).abs() <= edge)
        bend = _shifted(inverse, -1, dim) - 2.0 * inverse + _shifted(inverse, 1, dim)
        whole = read & (sides[0] > 0) & (sides[1] > 0)
        bends.append(torch.where(whole, bend.abs() / (math.sqrt(6.0) * sigma), torch.nan))
    rough = _local_median(torch.stack(bends, dim=1).float()) / _MEDIAN_OF_NORMAL
    rough = torch.where(has_company & ~fits, torch.inf, rough)
    return torch.where(read, rough, 0.0).to(depth.dtype)


def _shifted(image: Tensor, shift: int, dim: int) -> Tensor:
    """Return the image moved by ``shift`` pixels along a dimension; 0 comes in at the border."""
    moved = torch.zeros_like(image)
    length = image.shape[dim] - abs(shift)
    if length > 0:
        moved.narrow(dim, max(shift, 0), length).copy_(image.narrow(dim, max(-shift, 0), length))
    return moved


def _local_median(values: Tensor) -> Tensor:
    """Return (V, H, W) medians over the channels and a window of (V, C, H, W) without NaN; 0 where most are NaN."""
    views, _, height, width = values.shape
    margin = _WINDOW // 2
    padded = torch.nn.functional.pad(values, (margin, margin, margin, margin), value=math.nan)
    bands = []
    for start in range(0, height, _BAND):
        rows = min(_BAND, height - start)
        patches = torch.nn.functional.unfold(padded[:, :, start : start + rows + 2 * margin], _WINDOW)
        enough = 2 * (~patches.isnan()).sum(dim=1) >= patches.shape[1]
        median = torch.where(enough, patches.nanmedian(dim=1).values, 0.0)
        bands.append(median.reshape(views, rows, width))
    return torch.cat(bands, dim=1)
