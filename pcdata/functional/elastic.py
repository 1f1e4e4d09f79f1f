"""A smooth random bending of space, drawn where it is asked for: offsets of a lattice, interpolated."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from pcdata.functional.rows import cloud_of_rows
from pcdata.rng import words

# Of the interpolated offsets, in offsets of the lattice per its edge: the largest slope along any axis.
STEEPEST = 3.0


def lattice_offsets(
    points: Tensor,  # (N, 3), in any unit of length
    ptr: Tensor,  # (B+1,)
    seeds: Tensor,  # (B,) int64
    wavelength: float,
) -> tuple[Tensor, Tensor]:  # offsets (N, 3) in [-1, 1], slopes (N, 3, 3) of each along each axis; float64
    """Return the offset of every point, and how it changes with the point's place.

    The nodes of a lattice through the origin, ``wavelength`` apart, have offsets drawn evenly from [-1, 1] per axis, by
    the cloud's seed and the node's number alone: so a place is bent alike whatever else is in the cloud. Between nodes
    they are interpolated with smooth first derivatives.

    Source: Perlin, An image synthesizer, SIGGRAPH 1985 (value noise).
    """
    places = points.double() / wavelength
    cell = places.floor()
    t = places - cell
    smooth, slope = t * t * (3 - 2 * t), 6 * t * (1 - t)
    parts = torch.stack([1 - smooth, smooth]), torch.stack([-slope, slope])
    keys = seeds.to(points.device)[cloud_of_rows(ptr)]
    offsets = torch.zeros_like(places)
    slopes = places.new_zeros(len(places), 3, 3)
    for corner in itertools.product((0, 1), repeat=3):
        value = _drawn(keys, cell.long() + torch.tensor(corner, dtype=torch.int64, device=points.device))
        own = [parts[0][side, :, axis] for axis, side in enumerate(corner)]
        change = [parts[1][side, :, axis] for axis, side in enumerate(corner)]
        offsets += (own[0] * own[1] * own[2])[:, None] * value
        for axis in range(3):
            first, second = (own[other] for other in range(3) if other != axis)
            slopes[:, :, axis] += (change[axis] * first * second)[:, None] * value
    return offsets, slopes / wavelength


def _drawn(keys: Tensor, node: Tensor) -> Tensor:
    """Draw (N, 3) numbers in [-1, 1) for nodes (N, 3) of streams (N,)."""
    for axis in range(3):
        keys = words(keys, node[:, axis])
    axes = torch.arange(3, dtype=torch.int64, device=keys.device)
    word = words(keys[:, None], axes)
    return ((word >> 11) & ((1 << 53) - 1)).double() * 2.0**-52 - 1.0
