"""Hulls and surfaces of many points by the compiled core: the corners of the reference, in its order."""

from __future__ import annotations

import pytest
import torch

from pcdata.contracts.dispatch import why_unavailable
from pcdata.functional.plane_surfaces import plane_surfaces
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts
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


def assert_surfaces_equal(points, ptr, near, planes, distance):
    ours, theirs = (plane_surfaces(points, ptr, near, planes, distance, backend=name) for name in ("cpu", "torch"))
    assert torch.equal(ours[0], theirs[0])
    assert torch.equal(ours[1], theirs[1])
    torch.testing.assert_close(ours[2], theirs[2], rtol=1e-12, atol=0)
    assert not bool((ours[0] & ~near).any())
    return ours


@pytest.mark.parametrize("name", SETS)
def test_the_outline_is_that_of_the_reference(name):
    points, chosen = _lifted(name)
    for mask in (chosen, torch.zeros_like(chosen), torch.ones_like(chosen), torch.arange(len(chosen)) == 300):
        assert_surfaces_equal(points, torch.tensor([0, len(points)]), mask, PLANE[None], 1e-3)


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("distance", [1e-3, 0.05, 30.0])
def test_surfaces_of_large_and_small_clouds_are_those_of_the_reference(name, distance, monkeypatch):
    points, _ = _lifted(name)
    points = torch.cat([points, points[:, [0, 2, 1]], points.flip(0) * 0.5 + 0.01]).repeat(3, 1)  # 45,000, and walls
    counts = [len(points), 700, 0, 3, min(8193, len(points))]
    points = torch.cat([points[:count] for count in counts])
    ptr = ptr_from_counts(counts)
    planes = PLANE.repeat(len(counts), 1)
    planes[1:, 3] = 0.01
    own = planes[cloud_of_rows(ptr)]
    near = ((points.double() * own[:, :3]).sum(1) + own[:, 3]).abs() < distance
    found = assert_surfaces_equal(points, ptr, near, planes, distance)
    assert bool(found[0].any()) == bool(near.any())
    monkeypatch.setattr("pcdata.kernels.cpu.native.core_threads", lambda: 5)
    again = plane_surfaces(points, ptr, near, planes, distance, backend="cpu")
    assert all(torch.equal(*pair) for pair in zip(found, again, strict=True))


def test_corners_that_matter_least_are_left_out():
    """Of a circle of many points 24 stay, which are spread about it; of few all do, in their order."""
    turn = torch.linspace(0, 2 * torch.pi, 721, dtype=torch.float64)[:-1]
    ring = torch.stack([turn.cos(), turn.sin(), torch.zeros(720)], 1).float()
    plane, near = torch.tensor([[0.0, 0.0, 1.0, 0.0]], dtype=torch.float64), torch.ones(720, dtype=torch.bool)
    for step, left in ((1, 24), (30, 24), (40, 18)):
        some = ring[::step].contiguous()
        ptr = torch.tensor([0, len(some)])
        _, corners, rms = assert_surfaces_equal(some, ptr, near[: len(some)], plane, 0.05)
        kept = corners[0][corners[0] >= 0]
        assert len(kept) == left
        assert float(rms) == 0
        gaps = (turn[::step][kept].roll(-1) - turn[::step][kept]) % (2 * torch.pi)
        assert float(gaps.max()) < 2.1 * float(gaps.min())


def test_a_small_patch_and_a_wall_are_no_surface():
    generator = seeded(8)
    table = torch.rand(9000, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    stray = torch.rand(60, 3, generator=generator) * torch.tensor([0.1, 0.1, 0.0]) + torch.tensor([1.5, 0.5, 0.0])
    wall = torch.rand(6000, 3, generator=generator) * torch.tensor([0.02, 1.0, 0.8]) + torch.tensor([1.1, 0.0, -0.4])
    points = torch.cat([table, stray, wall])
    plane = torch.tensor([[0.0, 0.0, 1.0, 0.0]], dtype=torch.float64)
    near = points[:, 2].abs() < 0.01
    patch, corners, _ = assert_surfaces_equal(points, torch.tensor([0, len(points)]), near, plane, 0.01)
    assert bool(patch[:9000].all())
    assert not bool(patch[9000:].any())
    assert int(corners.max()) < 9000
