"""The hull of many points by the compiled core: the corners of the reference, in its order."""

from __future__ import annotations

import pytest
import torch

from pcdata.contracts.dispatch import why_unavailable
from pcdata.functional.plane_patch import outline_rows, patch_cells, points_in_cells
from pcdata.functional.selection import hull_rows, plane_axes
from pcdata.rng import seeded

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason="the compiled core is not there")


def _turned(points):
    turn = torch.tensor([[0.8, -0.6], [0.6, 0.8]], dtype=torch.float64)
    return points.double() @ turn


def _sets():
    generator = seeded(4)
    normal = torch.randn(5000, 2, generator=generator, dtype=torch.float64)
    grid = torch.cartesian_prod(torch.arange(60.0), torch.arange(50.0)).double()
    line = torch.arange(3000, dtype=torch.float64)[:, None] * torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    eighth = normal.clone()
    eighth[::8] = 0.25
    on_circle = torch.nn.functional.normalize(normal, dim=1)
    return {
        "normal": normal,
        "far away": normal * 1e-3 + 1e6,
        "grid": grid,
        "grid, shuffled": grid[torch.randperm(len(grid), generator=generator)],
        "grid, turned": _turned(grid),
        "line": line,
        "line, turned": _turned(line),
        "one point": torch.full((2000, 2), 0.3, dtype=torch.float64),
        "every eighth the same": eighth,
        "circle": on_circle,
        "flat": normal * torch.tensor([1.0, 1e-9], dtype=torch.float64),
        "tiny": normal * 1e-150,
        "huge": normal * 1e150,
        "few": normal[:511],
        "just many": normal[:513],
    }


SETS = _sets()


@pytest.mark.parametrize("name", SETS)
def test_the_hull_is_that_of_the_reference(name):
    points = SETS[name]
    assert torch.equal(hull_rows(points, backend="cpu"), hull_rows(points, backend="torch"))


PLANE = torch.nn.functional.normalize(torch.tensor([0.2, -0.3, 0.9, 0.0], dtype=torch.float64), dim=0)
AXES = plane_axes(PLANE).T.contiguous()


def _lifted(name):
    """Points about a plane through the origin, and some of them chosen; float32 holds their places."""
    flat, generator = SETS[name].clamp(-1e15, 1e15), seeded(5)
    points = flat @ AXES + 1e-3 * torch.randn(len(flat), 1, generator=generator, dtype=torch.float64) * PLANE[:3]
    return points.float(), torch.rand(len(flat), generator=generator) < 0.7


@pytest.mark.parametrize("name", SETS)
def test_the_outline_is_that_of_the_reference(name):
    points, chosen = _lifted(name)
    for mask in (chosen, torch.zeros_like(chosen), torch.ones_like(chosen), torch.arange(len(chosen)) == 300):
        ours, theirs = (outline_rows(points, mask, PLANE, AXES, backend=backend) for backend in ("cpu", "torch"))
        assert torch.equal(ours[0], theirs[0])
        assert ours[1] == pytest.approx(theirs[1], rel=1e-12)


@pytest.mark.parametrize("name", ["normal", "grid", "huge", "few"])
@pytest.mark.parametrize("scale", [0.01, 3.7, 1e20])
def test_cells_hold_the_points_of_the_reference(name, scale):
    points, chosen = _lifted(name)
    cells, low = torch.rand(9, 7, generator=seeded(6)) < 0.5, torch.tensor([-0.5, -1.25], dtype=torch.float64)
    found = [points_in_cells(points, chosen, AXES, low, scale, cells, backend=backend) for backend in ("cpu", "torch")]
    assert torch.equal(*found)
    assert not bool((found[0] & ~chosen).any())
    assert not len(points_in_cells(points[:0], chosen[:0], AXES, low, scale, cells, backend="cpu"))


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("distance", [1e-3, 0.05, 30.0])
def test_the_cells_of_a_surface_are_those_of_the_reference(name, distance):
    points, _ = _lifted(name)
    points = torch.cat([points, points[:, [0, 2, 1]], points.flip(0) * 0.5 + 0.01]).repeat(3, 1)  # 45,000, and walls
    for some, offset in ((points, 0.0), (points[:700], 0.01), (points[:0], 0.0)):
        near = (some.double() @ PLANE[:3] + offset).abs() < distance
        plane = torch.cat([PLANE[:3], torch.tensor([offset], dtype=torch.float64)])
        for mask in (near, torch.zeros_like(near)):
            ours, theirs = (
                patch_cells(some, mask, plane, AXES, distance, backend=backend) for backend in ("cpu", "torch")
            )
            assert torch.equal(ours[0], theirs[0])
            assert ours[1] == theirs[1]
            assert torch.equal(ours[2], theirs[2])
            assert bool(ours[2].any()) == bool(mask[:: max(1, len(mask) // 16384)].any())


def test_a_small_patch_and_a_wall_are_no_surface():
    generator = seeded(8)
    table = torch.rand(9000, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    stray = torch.rand(60, 3, generator=generator) * torch.tensor([0.1, 0.1, 0.0]) + torch.tensor([1.5, 0.5, 0.0])
    wall = torch.rand(6000, 3, generator=generator) * torch.tensor([0.02, 1.0, 0.8]) + torch.tensor([1.1, 0.0, -0.4])
    points = torch.cat([table, stray, wall])
    plane = torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=torch.float64)
    near, axes = points[:, 2].abs() < 0.01, plane_axes(plane).T.contiguous()
    for backend in ("cpu", "torch"):
        low, scale, cells = patch_cells(points, near, plane, axes, 0.01, backend=backend)
        found = points_in_cells(points, near, axes, low, scale, cells, backend=backend)
        assert bool(found[:9000].all())
        assert not bool(found[9000:].any())
