"""Color beside geometry: where both sides of a contact have other colors, or the same one.

Source: Richtsfeld et al., Learning of perceptual grouping for object segmentation on RGB-D data, JVCIR 2014 (color of
both patches as one relation among those of shape).
"""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.functional.touching.contacts import Contacts

_ASIDE = range(2, 7)  # pixels from the contact: nearer ones mix both sides, and color is registered to within two
_DARK = 0.04  # of full brightness, added before logarithms are taken: below it colors are noise
_BRIGHTNESS = 0.15  # how much it counts beside the ratios of channels: faces of one object differ in it
_FROM, _FULL = 0.1, 0.4  # logarithms of ratios: one color up to 10 %, surely two from 50 %
_WEIGHT = 0.5  # what geometry says is changed by half at most: it alone knows of valleys and steps


def with_colors(contacts: Contacts, label: Tensor, colors: Tensor) -> Contacts:  # (H, W) int64, (H * W, 3) float
    """Make contacts stronger where both sides have other colors, and weaker where they have the same.

    Each contact of two regions is judged as a whole, by the colors some pixels aside on its own sides. Where geometry
    says nothing color says nothing: a printed box has many colors.
    """
    if not len(contacts.first):
        return contacts
    flat, shade = label.flatten(), _shades(colors)
    differs = torch.full_like(contacts.strength, torch.nan)
    right = contacts.second - contacts.first == 1
    for rows, way in ((right, (0, 1)), (~right, (1, 0))):
        one = _beside(flat, shade, contacts.first[rows], (-way[0], -way[1]), label.shape)
        other = _beside(flat, shade, contacts.second[rows], way, label.shape)
        differs[rows] = (((one - other).norm(dim=1) - _FROM) / (_FULL - _FROM)).clamp(0, 1)
    a, b = flat[contacts.first], flat[contacts.second]
    pair = torch.minimum(a, b) * (int(flat.max()) + 1) + torch.maximum(a, b)
    _, number = pair.unique(return_inverse=True)
    known = ~differs.isnan()
    count = torch.bincount(number[known], minlength=int(number.max()) + 1)
    total = torch.bincount(number[known], weights=differs[known], minlength=len(count))
    mean = torch.where(count > 0, total / count.clamp(min=1), 0.5)[number]
    return contacts._replace(strength=(contacts.strength * (1 + _WEIGHT * (2 * mean - 1))).clamp(0, 1))


def _shades(colors: Tensor) -> Tensor:
    """Return (n, 4) logarithms of the channels over their mean, and a part of that mean."""
    logs = (colors.double() + _DARK).log()
    mean = logs.mean(1, keepdim=True)
    return torch.cat([logs - mean, _BRIGHTNESS * mean], 1)


def _beside(flat: Tensor, shade: Tensor, pixel: Tensor, way: tuple[int, int], shape: torch.Size) -> Tensor:
    """Return the mean shade (E, 4) of the pixels aside of each that are of its region; NaN where there is none."""
    height, width = shape
    own = flat[pixel]
    total, count = shade.new_zeros(len(pixel), 4), shade.new_zeros(len(pixel))
    for steps in _ASIDE:
        row, column = pixel // width + steps * way[0], pixel % width + steps * way[1]
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        there = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
        inside &= flat[there] == own
        total += torch.where(inside[:, None], shade[there], 0.0)
        count += inside
    return total / count[:, None]
