"""Convex hulls in space and the smallest boxes around points, held to solids that are known and to laws."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pcdata.errors import NonFiniteError, ShapeError, TooFewPointsError
from pcdata.functional import convex_hull_3d, smallest_box, smallest_rectangle
from pcdata.rng import seeded


def turn(seed: int) -> Tensor:
    """A rotation (3, 3) float64."""
    matrix = torch.linalg.qr(torch.randn(3, 3, generator=seeded(seed), dtype=torch.float64))[0]
    return matrix * torch.linalg.det(matrix)


def solid(name: str, seed: int = 0) -> Tensor:
    generator = seeded(seed)
    if name == "grid":  # most points lie inside of faces and edges
        line = torch.linspace(0, 1, 9, dtype=torch.float64)
        return torch.cartesian_prod(line, 2 * line, 3 * line)
    points = torch.randn(700, 3, generator=generator, dtype=torch.float64)
    if name == "ball":
        return torch.nn.functional.normalize(points, dim=1)
    return points * torch.tensor([1.0, 0.01, 5.0], dtype=torch.float64) if name == "flat cloud" else points


@pytest.mark.parametrize("shift", [0.0, 300.0])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("name", ["grid", "ball", "cloud", "flat cloud"])
def test_the_surface_is_closed_and_holds_every_point(name, scale, shift):
    points = solid(name) @ turn(1).T * scale + shift * scale
    hull = convex_hull_3d(points)
    directed = hull.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()
    assert len({tuple(edge) for edge in directed}) == len(directed)
    assert {tuple(edge) for edge in directed} == {(b, a) for a, b in directed}
    assert len(hull.corners) - len(directed) // 2 + len(hull.triangles) == 2  # Euler
    assert set(hull.triangles.flatten().tolist()) == set(hull.corners.tolist())
    a, b, c = ((points - points.mean(0)) / scale)[hull.triangles].unbind(1)
    across = torch.linalg.cross(b - a, c - a)  # some triangles are thin: they count by their area
    above = (points - points.mean(0)) / scale @ across.T - (a * across).sum(1)
    assert float(above.max()) < 1e-10 * (1 + shift)


def test_volume_and_area_are_those_of_the_solid():
    for seed in range(3):
        block = convex_hull_3d(solid("grid") @ turn(seed).T + 7)
        assert block.volume == pytest.approx(6.0, rel=1e-9)
        assert block.area == pytest.approx(22.0, rel=1e-9)
    assert len(convex_hull_3d(solid("grid")).corners) == 8
    corner = convex_hull_3d(torch.cat([torch.eye(3), torch.zeros(1, 3), torch.full((5, 3), 0.1)]))
    assert corner.corners.tolist() == [0, 1, 2, 3]
    assert corner.volume == pytest.approx(1 / 6)
    assert corner.area == pytest.approx(1.5 + math.sqrt(3) / 2)
    ball = convex_hull_3d(torch.nn.functional.normalize(torch.randn(20_000, 3, generator=seeded(0)), dim=1))
    assert ball.volume == pytest.approx(4 / 3 * math.pi, rel=0.002)
    assert ball.area == pytest.approx(4 * math.pi, rel=0.002)


def test_sets_of_fewer_dimensions_have_no_volume():
    square = torch.cartesian_prod(torch.linspace(0, 1, 5), torch.linspace(0, 1, 5), torch.zeros(1))
    for points in (square, (square.double() @ turn(2).T + 3)):
        hull = convex_hull_3d(points)
        assert (hull.corners.tolist(), hull.volume) == ([0, 4, 20, 24], 0.0)
        assert hull.area == pytest.approx(2.0)  # both sides
    line = torch.arange(5.0)[:, None] * torch.tensor([[1.0, 2.0, 3.0]])
    assert convex_hull_3d(line).corners.tolist() == [0, 4]
    assert convex_hull_3d(line[3:4].repeat(6, 1)).corners.tolist() == [0]
    nothing = convex_hull_3d(line[:0])
    assert (len(nothing.corners), len(nothing.triangles), nothing.volume, nothing.area) == (0, 0, 0.0, 0.0)
    with pytest.raises(NonFiniteError, match="convex_hull_3d: points"):
        convex_hull_3d(torch.full((4, 3), torch.nan))
    with pytest.raises(ShapeError, match="convex_hull_3d: points"):
        convex_hull_3d(torch.zeros(4, 2))


def volume_at(points: Tensor, rotations: Tensor) -> Tensor:
    """Volumes (R,) of the boxes around points along the columns of rotations."""
    places = points @ rotations
    return (places.amax(1) - places.amin(1)).prod(1)


@pytest.mark.parametrize("name", ["ball", "cloud", "flat cloud", "grid"])
def test_the_box_holds_every_point_and_turned_boxes_are_not_smaller(name):
    points = (solid(name, 3)[:150] @ turn(3).T) + 2
    pose, size = smallest_box(points)
    axes = pose[:3, :3]
    torch.testing.assert_close(axes.T @ axes, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)
    assert float(torch.linalg.det(axes)) > 0
    assert size.tolist() == sorted(size.tolist(), reverse=True)
    inside = (points - pose[:3, 3]) @ axes
    assert bool((inside.abs() <= size / 2 + 1e-9).all())
    assert bool((inside.amax(0) >= size / 2 - 1e-9).all())
    generator = seeded(4)
    random = torch.linalg.qr(torch.randn(2000, 3, 3, generator=generator, dtype=torch.float64))[0]
    least = float(size.prod())
    assert least <= float(volume_at(points, random).min()) * 1.003
    # Turned about its own axes it cannot be made smaller.
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        _, _, sides = smallest_rectangle(points @ axes[:, others])
        assert float(size[axis] * sides.prod()) >= least * (1 - 1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_blocks_and_a_tetrahedron_have_the_boxes_that_are_known(seed):
    pose, size = smallest_box(solid("grid") @ turn(seed).T + 1)
    assert size.tolist() == pytest.approx([3.0, 2.0, 1.0])
    assert (pose[:3, :3].T @ turn(seed)[:, [2, 1, 0]]).abs().diagonal().tolist() == pytest.approx([1.0] * 3)
    torch.testing.assert_close(pose[:3, 3], turn(seed) @ torch.tensor([0.5, 1, 1.5]).double() + 1, atol=1e-9, rtol=0)
    # A regular tetrahedron lies in a cube, of whose faces it has no side: O'Rourke's example.
    tetrahedron = torch.tensor([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]], dtype=torch.float64)
    assert smallest_box(tetrahedron @ turn(seed).T)[1].tolist() == pytest.approx([1.0] * 3)


def test_flat_sets_and_single_points_have_boxes_without_height():
    square = torch.rand(60, 2, generator=seeded(0), dtype=torch.float64) * torch.tensor([2.0, 1.0])
    points = torch.cat([square, torch.zeros(60, 1, dtype=torch.float64)], 1) @ turn(5).T
    _, _, sides = smallest_rectangle(square)
    assert smallest_box(points)[1].tolist() == pytest.approx([*sides.tolist(), 0.0], abs=1e-9)
    line = torch.arange(5.0)[:, None] * torch.tensor([[1.0, 2.0, 2.0]])
    assert smallest_box(line)[1].tolist() == pytest.approx([12.0, 0.0, 0.0], abs=1e-6)
    pose, size = smallest_box(line[2:3].repeat(4, 1))
    assert (pose[:3, 3].tolist(), size.tolist()) == ([2.0, 4.0, 4.0], [0.0] * 3)
    with pytest.raises(TooFewPointsError, match="smallest_box: there are no points"):
        smallest_box(line[:0])
