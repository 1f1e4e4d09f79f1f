"""Heights over the surface that a table is: distances from the sensor, and the fit."""

from __future__ import annotations

import ctypes
from itertools import pairwise

import torch
from torch import Tensor

from pcdata.contracts.dispatch import kernel
from pcdata.functional.selection import plane_axes
from pcdata.functional.surface_fit import (
    BESIDE,
    LEAST_NOISE,
    MAD,
    OWN,
    ROUNDS,
    SAMPLE,
    SurfaceFit,
    require_table,
)
from pcdata.kernels.cpu.native import answers, call, room


@kernel("reaches", "cpu")
def reaches(points: Tensor, ptr: Tensor, places: Tensor, least: float) -> Tensor:
    """Take the distances of a cloud from its place, or of all points from their own, in one pass."""
    reach = room(len(points), torch.float64)
    points, places = points.contiguous(), places.contiguous()
    if len(places) == len(points):
        call("pc_reach", points, len(points), places, len(places), float(least), reach)
        return reach
    for place, (start, stop) in zip(places, pairwise(ptr.tolist())):
        call("pc_reach", points[start:stop], stop - start, place, 1, float(least), reach[start:stop])
    return reach


@kernel("fit_surface", "cpu")
def fit_surface(points: Tensor, reach: Tensor, plane: Tensor, distance: float, where: str) -> SurfaceFit:
    """Fit without a pass through memory for every term; sums are added in eight lanes, whatever the processor."""
    step = max(1, -(-len(points) // SAMPLE))
    numbers = torch.tensor([distance, step, ROUNDS, OWN, *BESIDE, MAD, LEAST_NOISE], dtype=torch.float64, device="cpu")
    height, found = room(len(points), torch.float64), answers(4, ctypes.c_double)
    given = points.contiguous(), len(points), reach.contiguous(), plane.contiguous(), plane_axes(plane).contiguous()
    call("pc_fit_surface", *given, numbers, height, found)
    noise, typical, clutter, num_near = found
    require_table(where, int(num_near), distance)
    return SurfaceFit(height, noise, typical, clutter)
