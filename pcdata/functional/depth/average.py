"""One depth image out of many of a still scene, without holes, jitter or moved edges."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ConfigError, ShapeError
from pcdata.functional.depth.pixel_sort import pick_image, sort_images
from pcdata.threads import at_once

# The median absolute deviation of a normal distribution is 0.6745 of its standard deviation.
_SIGMA_PER_MAD = 1.4826
_BLOCK = 1 << 15  # pixels handled at once: ten images of so many floats stay in a processor's cache


class DepthAverage(NamedTuple):
    """What is known of every pixel after T readings of it."""

    depth: Tensor  # (V, H, W) float32 metres: the mean of the readings kept, 0 = too few
    num_readings: Tensor  # (V, H, W) int64: how many were kept
    variance: Tensor  # (V, H, W) float32 square metres: sample variance of those kept, 0 for fewer than two
    num_jitter: Tensor  # (V, H, W) int64: readings dropped because they stray from the median
    num_jumps: Tensor  # (V, H, W) int64: those of them that lie beyond max_jump: another surface, or motion


def average_depth(
    depths: Tensor,  # (T, V, H, W) float32 metres, 0 = no reading
    *,
    mad_factor: float = 5.0,
    resolution: float = 0.001,
    max_jump: float = 0.03,
    min_count: int = 1,
) -> DepthAverage:
    """Average T depth images of a still scene; "no reading" counts for nothing.

    The pixel's median is the lower one, so always a reading. A reading is jitter, and dropped, if it lies further from
    the median than ``mad_factor`` standard deviations (taken as 1.4826 times the median absolute deviation, which is at
    least ``resolution``) or than ``max_jump`` times the median. So a pixel at an edge that flickers between two
    surfaces takes the one it saw more often (the nearer when in doubt), never a depth in between.

    Args:
        depths: the images.
        mad_factor: jitter limit in standard deviations. Of ten readings the deviation is known to a third only: at 3, a
            twentieth of good normal readings goes and the average is a tenth noisier.
        resolution: metres, the step of the sensor's readings: a spread below it is not seen.
        max_jump: as a part of the median depth: what is further away is another surface. Three standard deviations of
            the noise should fit in; for stereo, whose noise grows with the square of the distance, raise it far away.
        min_count: a pixel with fewer readings kept has no reading.

    Raises:
        ShapeError: there is no image, or the shape is another.
        CaptureError: a negative depth.
        ConfigError: a limit out of range.
    """
    where = "average_depth"
    check_tensors(where, {"depths": depths}, {"depths": "T V H W : depth"})
    if len(depths) == 0:
        raise ShapeError(f"{where}: depths must hold at least one image, got shape {tuple(depths.shape)}")
    if not (mad_factor > 0 and resolution >= 0 and max_jump > 0 and min_count >= 1):
        raise ConfigError(
            f"{where}: needs mad_factor > 0, resolution >= 0, max_jump > 0 and min_count >= 1, got {mad_factor}, "
            f"{resolution}, {max_jump}, {min_count}"
        )
    flat = depths.flatten(1)
    blocks = flat.split(at_once(flat.device, _BLOCK), dim=1)
    parts = [_average(part, mad_factor, resolution, max_jump, min_count) for part in blocks]
    return DepthAverage(*(torch.cat(values).reshape(depths.shape[1:]) for values in zip(*parts, strict=True)))


def _average(readings: Tensor, mad_factor: float, resolution: float, max_jump: float, min_count: int) -> DepthAverage:
    """Average (T, N) readings of N pixels."""
    valid = readings > 0
    num_valid = valid.sum(0)
    median = _lower_median(torch.where(valid, readings, torch.inf), num_valid)
    median = torch.where(num_valid > 0, median, 0.0)  # inf - inf would be NaN below
    deviation = readings - median
    distance = torch.where(valid, deviation.abs(), torch.inf)
    spread = _lower_median(distance, num_valid)
    far = max_jump * median
    limit = torch.minimum(mad_factor * _SIGMA_PER_MAD * spread.clamp(min=resolution), far)
    kept = distance <= limit
    count = kept.sum(0)
    # About the median rather than about zero: the squares of metres would swallow those of millimetres.
    deviation = torch.where(kept, deviation, 0.0)
    mean = deviation.sum(0) / count.clamp(min=1)
    variance = torch.where(kept, deviation - mean, 0.0).square().sum(0) / (count - 1).clamp(min=1)
    enough = count >= min_count
    return DepthAverage(
        depth=torch.where(enough, median + mean, 0.0),
        num_readings=count,
        variance=variance,
        num_jitter=num_valid - count,
        num_jumps=(valid & (distance > far)).sum(0),
    )


def _lower_median(values: Tensor, count: Tensor) -> Tensor:
    """Return the lower median of the ``count`` smallest of (T, N) values, the rest being infinite."""
    ordered = sort_images(values.unbind(0))
    return pick_image(ordered, (count - 1).clamp(min=0) // 2)
