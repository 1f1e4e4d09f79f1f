"""Rims of surfaces that are known, and PCL's rule in a loop over points."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from pcdata.errors import ConfigError, ShapeError
from pcdata.functional.boundaries import boundary_mask
from pcdata.functional.rows import ptr_from_counts
from pcdata.rng import seeded

UP = torch.tensor([0.0, 0.0, 1.0])


def sheet(side: int = 12, hole: int = 0) -> torch.Tensor:
    axis = torch.arange(float(side))
    points = torch.cartesian_prod(axis, axis, torch.zeros(1)) * 0.01
    middle = (points - points.mean(0)).abs().amax(1)
    return points[middle > hole * 0.01 * 0.5 + 1e-6] if hole else points


def test_the_rim_of_a_sheet_and_of_its_hole_is_found():
    points = sheet(12)
    edge = ((points[:, :2] < 1e-6) | (points[:, :2] > 0.1099)).any(1)
    assert torch.equal(boundary_mask(points, UP.expand(144, 3), radius=0.015), edge)
    points = sheet(12, hole=3)
    outside = ((points[:, :2] < 1e-6) | (points[:, :2] > 0.1099)).any(1)
    beside = ((points - sheet(12).mean(0)).abs().amax(1) < 0.0251) & ~outside
    found = boundary_mask(points, UP.expand(len(points), 3), radius=0.0145, min_gap=math.pi * 0.6)
    assert bool(found[outside].all())
    assert not bool(found[~outside & ~beside].any())
    assert bool(found[beside].any())


def by_loops(points: np.ndarray, normals: np.ndarray, radius: float, most: int, gap: float) -> list[bool]:
    """PCL's rule."""
    found = []
    for point, normal in zip(points, normals):
        distance = np.linalg.norm(points - point, axis=1)
        near = [row for row in np.argsort(distance, kind="stable")[:most] if distance[row] < radius]
        axis = np.linalg.svd(normal[None])[2][1:]
        flat = (points[near] - point) @ axis.T
        angles = sorted(math.atan2(y, x) for x, y in flat if abs(x) + abs(y) > 1e-12)
        gaps = [b - a for a, b in pairwise(angles)] + ([2 * math.pi - angles[-1] + angles[0]] if angles else [])
        found.append(len(near) >= 3 and bool(gaps) and max(gaps) > gap)
    return found


@pytest.mark.parametrize("seed", range(4))
def test_it_is_pcls_rule_on_surfaces_that_bend(seed):
    points = torch.rand(300, 3, generator=seeded(seed)) * 0.1
    points[:, 2] = 0.02 * (points[:, 0] * 40).sin()
    normals = torch.stack([-0.8 * (points[:, 0] * 40).cos(), 0 * points[:, 0], torch.ones(300)], 1) * 2
    found = boundary_mask(points, normals, radius=0.02, max_neighbors=20, min_gap=1.5)
    assert found.tolist() == by_loops(points.double().numpy(), normals.double().numpy(), 0.02, 20, 1.5)
    assert torch.equal(found, boundary_mask(points, -normals, radius=0.02, max_neighbors=20, min_gap=1.5))


def test_few_neighbors_and_no_normal_tell_nothing():
    points = torch.cat([sheet(3), sheet(3)[:2] + 5])
    found = boundary_mask(points, UP.expand(11, 3), ptr_from_counts([9, 2]), radius=0.015)
    assert found.tolist() == [True] * 4 + [False] + [True] * 4 + [False] * 2
    assert not bool(boundary_mask(points, torch.zeros(11, 3), radius=1.0).any())


def test_wrong_values_are_refused():
    points = sheet(3)
    for gap in (0.0, 7.0, -1.0):
        with pytest.raises(ConfigError, match="boundary_mask: min_gap"):
            boundary_mask(points, points, min_gap=gap)
    with pytest.raises(ShapeError, match=r"boundary_mask: .*normals"):
        boundary_mask(points, points[:3])
