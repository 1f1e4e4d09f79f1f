"""Connected parts of images: where they end, how large they are, and how they take what lies beside them."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.functional.touching.limits import LEVELS, Limits
from pcdata.functional.touching.windows import PixelCamera


def jumps(inverse: Tensor, there: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """Mark the pairs of neighbors in rows (H, W-1) and columns (H-1, W) with a jump between them.

    Neither the step itself nor its difference from the step before or behind it may be small.
    """
    return _row_jumps(inverse, there, limit), _row_jumps(inverse.T, there.T, limit).T


def _row_jumps(inverse: Tensor, there: Tensor, limit: float) -> Tensor:
    both = there[:, 1:] & there[:, :-1]
    step = inverse[:, 1:] - inverse[:, :-1]
    bend = (step[:, 1:] - step[:, :-1]).abs() > limit
    jump = both & (step.abs() > limit)
    jump[:, 1:] &= bend | ~both[:, :-1]
    jump[:, :-1] &= bend | ~both[:, 1:]
    return jump


def parted_at_jumps(
    inverse: Tensor,  # (H, W) float64
    label: Tensor,  # (H, W) int64, -1 = none
    camera: PixelCamera,
    noise: float,
    limits: Limits,
) -> Tensor:  # (H, W) int64
    """Make regions of their own of what jumps part in one; parts smaller than seeds are of none."""
    across, along = jumps(inverse, inverse > 0, limits.jump * noise)
    across, along = across | (label[:, 1:] != label[:, :-1]), along | (label[1:] != label[:-1])
    part, large = large_parts(label >= 0, across, along, inverse, camera, limits.seed_area)
    return torch.where(large, large.cumsum(0) - 1, -1)[part]


def cut_regions(
    inverse: Tensor,  # (H, W) float64
    label: Tensor,  # (H, W) int64, -1 = none
    steep: Tensor,  # (H, W) bool
    across: Tensor,  # the jumps
    along: Tensor,
    camera: PixelCamera,
    limits: Limits,
) -> Tensor:  # (H, W) int64, in the order of first pixels
    """Cut regions in which jumps, and lines that are steep, part two and more large parts.

    The parts take what else there is of their region, one pixel at a time.
    """
    none, count = label.numel(), int(label.max()) + 1 if label.numel() else 0
    if count == 0:
        return label
    border_across, border_along = label[:, 1:] != label[:, :-1], label[1:] != label[:-1]
    part, large = large_parts(
        (label >= 0) & ~steep, across | border_across, along | border_along, inverse, camera, limits.part_area
    )
    is_cut = torch.bincount(label.flatten()[large.nonzero().squeeze(1)], minlength=count) > 1
    pixel = torch.arange(none, dtype=torch.int64, device=label.device)
    first = torch.full((count + 1,), none, dtype=torch.int64, device=label.device)
    first.scatter_reduce_(0, label.flatten() + 1, pixel, "amin")
    own = label.clamp(min=0)
    start = torch.where(is_cut[own], torch.where(large[part], part, none), first[own + 1])
    start = torch.where(label >= 0, start, none)
    seeds = torch.where(start < none, torch.searchsorted(start[start < none].unique(), start), -1)
    return flooded(seeds, torch.zeros_like(inverse), label >= 0, border_across, border_along)


def large_parts(
    mask: Tensor, across: Tensor, along: Tensor, inverse: Tensor, camera: PixelCamera, least: float
) -> tuple[Tensor, Tensor]:
    """Return the connected part (H, W) of every pixel, see :func:`connected_pixels`, and which cover so many m2."""
    part = connected_pixels(mask, across, along)
    area = 1 / (inverse * inverse).clamp(min=1e-12) / (camera.fx * camera.fy)
    size = torch.zeros(mask.numel() + 1, dtype=torch.float64, device=mask.device)
    size.index_add_(0, part.flatten(), torch.where(mask, area, 0.0).flatten())
    large = size >= least
    large[-1] = False
    return part, large


def connected_pixels(mask: Tensor, across: Tensor, along: Tensor) -> Tensor:
    """Return for every pixel of the mask the lowest pixel it is connected to, over neighbors without a jump.

    H * W stands where the mask is not.
    """
    height, width = mask.shape
    none = height * width
    pixel = torch.arange(none, dtype=torch.int64, device=mask.device).reshape(height, width)
    pairs = []
    for linked, first, second in (
        (mask[:, 1:] & mask[:, :-1] & ~across, pixel[:, :-1], pixel[:, 1:]),
        (mask[1:] & mask[:-1] & ~along, pixel[:-1], pixel[1:]),
    ):
        pairs.append(torch.stack([first[linked], second[linked]]))
    link = torch.cat(pairs, 1)
    lowest = torch.arange(none + 1, dtype=torch.int64, device=mask.device)
    while True:
        a, b = lowest[link[0]], lowest[link[1]]
        if bool((a == b).all()):
            break
        lowest.scatter_reduce_(0, torch.maximum(a, b), torch.minimum(a, b), "amin")
        while not bool((lowest[lowest] == lowest).all()):
            lowest = lowest[lowest]
    return torch.where(mask, lowest[:-1].reshape(height, width), none)


def flooded(label: Tensor, crease: Tensor, there: Tensor, across: Tensor, along: Tensor) -> Tensor:
    """Let regions (-1 = none) take all pixels that they reach over open borders: see :func:`smooth_regions`."""
    none = torch.iinfo(torch.int64).max
    level = (crease * LEVELS).floor().to(torch.int64)
    label = torch.where(label < 0, none, label)
    for now in range(LEVELS + 1):
        dry = there & (level <= now)
        while True:
            reached = torch.full_like(label, none)
            left, right = label[:, :-1], label[:, 1:]
            reached[:, 1:] = torch.minimum(reached[:, 1:], torch.where(across, none, left))
            reached[:, :-1] = torch.minimum(reached[:, :-1], torch.where(across, none, right))
            reached[1:] = torch.minimum(reached[1:], torch.where(along, none, label[:-1]))
            reached[:-1] = torch.minimum(reached[:-1], torch.where(along, none, label[1:]))
            taken = dry & (label == none) & (reached < none)
            if not bool(taken.any()):
                break
            label = torch.where(taken, reached, label)
    return torch.where(label == none, -1, label)
