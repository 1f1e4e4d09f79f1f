"""Boxes, polygons, hulls and repeats against matplotlib, SciPy and Python's own sets."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from pcdata import functional as F
from pcdata.errors import ConfigError, NonFiniteError, ShapeError
from pcdata.functional.selection import hull_rows
from pcdata.rng import seeded


def test_each_cloud_has_a_box_of_its_own():
    points, ptr = torch.rand(90, 3, generator=seeded(0)), torch.tensor([0, 30, 30, 90])
    lower = torch.tensor([[0.2, 0.0, 0.0], [9.0, 9.0, 9.0], [0.0, 0.5, 0.1]])
    inside = F.box_mask(points, ptr, lower=lower, upper=lower + 0.6)
    for b, (start, stop) in enumerate([(0, 30), (30, 30), (30, 90)]):
        own = F.box_mask(points[start:stop], lower=lower[b], upper=lower[b] + 0.6)
        assert torch.equal(inside[start:stop], own)
    assert 0 < int(inside.sum()) < 90
    with pytest.raises(ConfigError, match="cloud 1 has"):
        F.box_mask(points, ptr, lower=lower, upper=lower + torch.tensor([[1.0], [0.0], [1.0]]))


def winding(x: float, y: float, corners: np.ndarray) -> bool:
    """Inside by the sum of angles, odd turns."""
    offset = corners - (x, y)
    following = np.roll(offset, -1, 0)
    cross = offset[:, 0] * following[:, 1] - offset[:, 1] * following[:, 0]
    turns = np.arctan2(cross, (offset * following).sum(1)).sum() / (2 * np.pi)
    return round(turns) % 2 != 0


@pytest.mark.parametrize("seed", range(6))
def test_concave_and_crossing_polygons_hold_what_their_winding_says(seed):
    rng = np.random.default_rng(seed)
    corners = rng.random((int(rng.integers(3, 12)), 2))
    points = torch.from_numpy(rng.random((300, 2))).float()
    for way in (corners, corners[::-1].copy()):
        inside = F.polygon_mask(points, polygon=way)
        assert inside.tolist() == [winding(x, y, corners) for x, y in points.double().tolist()]


def test_polygons_that_share_an_edge_share_no_point():
    axis = torch.linspace(0, 2, 9)
    points = torch.cartesian_prod(axis, axis)
    left = F.polygon_mask(points, polygon=[[0, 0], [1, 0], [1, 2], [0, 2]])
    right = F.polygon_mask(points, polygon=[[1, 0], [2, 0], [2, 2], [1, 2]])
    assert not bool((left & right).any())
    assert int((left | right).sum()) == 8 * 8
    with pytest.raises(ShapeError, match=r"corners \(P, 2\), three or more, got \(2, 2\)"):
        F.polygon_mask(points, polygon=[[0, 0], [1, 1]])


def test_only_later_repeats_within_a_cloud_are_marked():
    points = torch.randint(0, 3, (200, 3), generator=seeded(1)).float()
    points[::5] *= -1.0  # -0 equals 0
    ptr = torch.tensor([0, 80, 200])
    wanted = []
    for start, stop in ((0, 80), (80, 200)):
        seen: set[tuple[float, ...]] = set()
        for row in points[start:stop].tolist():
            wanted.append(tuple(row) in seen)
            seen.add(tuple(row))
    assert F.duplicate_mask(points, ptr).tolist() == wanted


@pytest.mark.parametrize("kind", ["disk", "lattice", "ring", "skewed"])
def test_hulls_are_scipys(kind):
    points = torch.rand(500, 2, generator=seeded(2), dtype=torch.float64)
    if kind == "lattice":
        points = torch.cartesian_prod(torch.arange(7.0), torch.arange(9.0)).double()
    if kind == "ring":
        angle = torch.linspace(0, 6.28, 60, dtype=torch.float64)
        points = torch.stack([angle.cos(), angle.sin()], 1)
    if kind == "skewed":
        points = points @ torch.tensor([[1000.0, 999.0], [0.0, 0.01]], dtype=torch.float64)
    hull = F.convex_hull(points).tolist()
    assert hull == hull_rows(points, backend="torch").tolist()
    wanted = ConvexHull(points.numpy()).vertices.tolist()  # counterclockwise too
    assert sorted(hull) == sorted(wanted)
    first = wanted.index(hull[0])
    assert hull == wanted[first:] + wanted[:first]


def test_hulls_of_lines_and_single_points_have_fewer_corners():
    line = torch.stack([torch.arange(5.0), 2 * torch.arange(5.0)], 1)
    assert sorted(F.convex_hull(line).tolist()) == [0, 4]
    assert F.convex_hull(line[:1].repeat(3, 1)).tolist() == [0]
    assert F.convex_hull(line[:0]).tolist() == []
    assert all(
        F.convex_hull(line[:n]).tolist() == hull_rows(line[:n].double(), backend="torch").tolist() for n in range(6)
    )


def test_hulls_of_what_is_no_point_are_refused():
    with pytest.raises(NonFiniteError, match="convex_hull: points"):
        F.convex_hull(torch.tensor([[0.0, 0.0], [torch.nan, 1.0]]))
    with pytest.raises(ShapeError, match="convex_hull: points"):
        F.convex_hull(torch.zeros(4, 3))
