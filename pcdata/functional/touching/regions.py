"""Smooth regions of a depth image: faces of objects, bounded by creases and jumps.

Source: Meyer, Topographic distance and watershed lines, Signal Processing 38, 1994 (flooding from markers); Richtsfeld
et al., Segmentation of unknown objects in indoor environments, IROS 2012 (surfaces first, then objects).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.functional.touching.limits import CREASE_PIXELS, NORMAL_PIXELS, SMOOTH, STEEP_PIXELS, Limits
from pcdata.functional.touching.parts import cut_regions, flooded, jumps, large_parts
from pcdata.functional.touching.windows import (
    PixelCamera,
    dot,
    in_pixels,
    is_steep,
    length,
    plane_normal,
    rays,
    shifted,
    spread,
    window_planes,
)


class Regions(NamedTuple):
    """The regions of an image; all without a region where there is no reading."""

    label: Tensor  # (H, W) int64, in the order of first pixels, -1 = none
    normals: Tensor  # (H, W, 3) float64 unit normals toward the camera; 0 where none could be fitted


@inner
def smooth_regions(
    inverse: Tensor,  # (H, W) float64, 1/z in 1/m, 0 = no reading
    camera: PixelCamera,
    noise: float,
    limits: Limits,
    *,
    backend: str = "auto",
) -> Regions:
    """Cut the readings of an image into regions that are smooth inside.

    Planes are linear in 1/z over the image, and the noise of sensors that triangulate is the same everywhere in it, so
    all is fitted and compared there. Regions start where no crease is near and flood the rest, over jumps last: through
    ever sharper creases, one pixel at a time, the lowest of the regions that reach a pixel first. Then those are cut
    that reach over jumps, or over a line which is steeper than any surface that is followed: a jump that the sensor has
    smeared.
    """
    there = inverse > 0
    scale = spread(noise)
    rows, columns = rays(inverse.shape, camera, inverse.device)
    reach = in_pixels(limits.normal_reach * scale, camera, inverse, NORMAL_PIXELS)
    planes = window_planes(inverse, there, reach, camera, noise, limits)
    normals = plane_normal(planes.right, planes.down, planes.middle, columns, rows, camera)
    normals = torch.where(planes.found[..., None], normals, 0.0)
    crease = _creases(inverse, there, normals, camera, noise, limits, rows, columns, scale)
    across, along = jumps(inverse, there, limits.jump * noise)
    label = _seeds(inverse, there, crease, across, along, camera, limits)
    for closed_across, closed_along in ((across, along), (torch.zeros_like(across), torch.zeros_like(along))):
        label = flooded(label, crease, there, closed_across, closed_along)
    reach = in_pixels(limits.normal_reach * scale, camera, inverse, STEEP_PIXELS)
    planes = window_planes(inverse, there, reach, camera, noise, limits)
    steep = is_steep(planes, columns, rows, camera, limits)
    return Regions(cut_regions(inverse, label, steep, across, along, camera, limits), normals)


def _creases(
    inverse: Tensor,
    there: Tensor,
    normals: Tensor,
    camera: PixelCamera,
    noise: float,
    limits: Limits,
    rows: Tensor,
    columns: Tensor,
    scale: float,
) -> Tensor:
    """Return how sharp the crease at every pixel is, 0 to 1: the sharpest of four directions, smoothed."""
    depth = torch.where(there, 1 / torch.where(there, inverse, 1.0), 0.0)
    points = torch.stack([columns * depth, rows * depth, depth], dim=-1)
    reach = in_pixels(limits.crease_reach * scale, camera, inverse, CREASE_PIXELS)
    fitted = (normals != 0).any(-1)
    sharpest = torch.zeros_like(inverse)
    for right, down in ((1, 0), (0, 1), (1, 1), (1, -1)):
        # Diagonal steps are longer.
        steps = reach if right * down == 0 else (reach * math.sqrt(0.5) + 0.5).floor().clamp(min=1)
        for count in steps[there].unique().to(torch.int64).tolist():
            usable = there & (steps == count)
            for one in (-count, count):
                usable &= shifted(fitted, one * down, one * right)
            last = shifted(inverse, -count * down, -count * right)
            for step in range(1 - count, count + 1):
                now = shifted(inverse, step * down, step * right)
                usable &= (now > 0) & ((now - last).abs() < limits.step * noise)
                last = now
            before, behind = (shifted(normals, one * down, one * right) for one in (-count, count))
            way = shifted(points, count * down, count * right) - shifted(points, -count * down, -count * right)
            apart = length(behind - before)
            # Normals that lean toward each other stand in a valley.
            part = torch.where(dot(behind - before, way) < 0, apart, limits.convex_part * apart)
            sharpest = torch.maximum(sharpest, torch.where(usable, part, 0.0))
    return _smoothed((sharpest / limits.full_crease).clamp(max=1), there)


# A Gaussian of one pixel.
_KERNEL = (0.054488, 0.244202, 0.402619, 0.244202, 0.054488)


def _smoothed(image: Tensor, there: Tensor) -> Tensor:
    """Average with a Gaussian over the pixels that are there."""
    total, weight = torch.where(there, image, 0.0), there.to(image.dtype)
    for down, right in ((1, 0), (0, 1)):
        total, weight = (_convolved(one, down, right) for one in (total, weight))
    return torch.where(there, total / torch.where(there, weight, 1.0), 1.0)


def _convolved(image: Tensor, down: int, right: int) -> Tensor:
    result = torch.zeros_like(image)
    for offset, factor in enumerate(_KERNEL, -2):
        result += factor * shifted(image, offset * down, offset * right)
    return result


def _seeds(
    inverse: Tensor,
    there: Tensor,
    crease: Tensor,
    across: Tensor,
    along: Tensor,
    camera: PixelCamera,
    limits: Limits,
) -> Tensor:
    """Number the parts that are smooth together with all pixels around them, and large enough.

    First the smoothest, then what is as smooth as the next limit and holds none of them; each in the order of first
    pixels.
    """
    open_ = there.clone()
    open_[:, 1:] &= ~across
    open_[:, :-1] &= ~across
    open_[1:] &= ~along
    open_[:-1] &= ~along
    seeds = torch.full_like(crease, -1, dtype=torch.int64)
    number = 0
    for factor in SMOOTH:
        if factor > limits.roughest:
            break
        smooth = open_ & (crease < limits.smooth * factor)
        inside = smooth.clone()
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                inside &= shifted(smooth, down, right)
        least = limits.seed_area if factor == 1 else limits.rough_area
        part, large = large_parts(inside, across, along, inverse, camera, least)
        large[part[inside & (seeds >= 0)]] = False  # holds a smoother one
        own = torch.where(large, large.cumsum(0) - 1 + number, -1)[part]
        seeds = torch.where(own >= 0, own, seeds)
        number += int(large.sum())
    return seeds
