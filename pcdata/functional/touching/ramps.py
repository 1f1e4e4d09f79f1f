"""Jumps that a sensor has smoothed, made sharp again.

Stereo matching by windows shows a jump as a ramp of a dozen pixels, which hangs between both surfaces: a bridge.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.functional.touching.limits import RAMP, Limits
from pcdata.functional.touching.windows import PixelCamera


def sharpened(inverse: Tensor, camera: PixelCamera, noise: float, limits: Limits) -> Tensor:
    """Put the pixels of ramps on the nearer one, in 1/z, of the two surfaces that the ramp joins.

    A ramp is a run of 2 to 12 steps one way along a row or a column of 1/z (H, W, 0 = no reading), each steeper than
    any surface that is followed, and together by more than noise. What is steep for longer is a surface.
    """
    limit = limits.jump * noise
    rows = _sharpened_rows(inverse, limit, limits.slope / camera.fx)
    return _sharpened_rows(rows.T.contiguous(), limit, limits.slope / camera.fy).T.contiguous()


def _sharpened_rows(image: Tensor, limit: float, steepness: float) -> Tensor:
    left, right = image[:, :-1], image[:, 1:]
    step = right - left
    steep = (step.abs() > steepness * torch.maximum(left, right)) & (left > 0) & (right > 0)
    row, column = steep.nonzero().unbind(1)
    if not len(row):
        return image
    rises = step[row, column] > 0
    first = torch.ones_like(rises)
    first[1:] = (row[1:] != row[:-1]) | (column[1:] != column[:-1] + 1) | (rises[1:] != rises[:-1])
    run = first.cumsum(0) - 1
    count = torch.bincount(run)
    before = image[row[first], column[first]]
    behind = image[row[first], column[first] + count]
    followed = steepness * torch.maximum(before, behind)
    is_ramp = (count > 1) & (count <= RAMP) & ((behind - before).abs() > limit + count * followed)
    inner = is_ramp[run] & ~first  # pixels between two steps of one ramp
    row, column, run = row[inner], column[inner], run[inner]
    own, one, other = image[row, column], before[run], behind[run]
    result = image.clone()
    result[row, column] = torch.where((own - one).abs() <= (other - own).abs(), one, other)
    return result
