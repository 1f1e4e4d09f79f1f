"""Ray hits, normals and signed distances of the solids, against each other and against geometry."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pcdata.errors import ConfigError
from pcdata.geometry import rigid
from pcdata.rng import seeded
from pcdata.synthetic import Box, Cylinder, Shape, Sphere, Turned, bowl_profile, mug_profile


def _pose() -> Tensor:
    axis = torch.nn.functional.normalize(torch.tensor([0.3, -0.8, 0.5], dtype=torch.float64), dim=0)
    return rigid.from_rotation_translation(
        rigid.rotation_about_axis(axis, torch.tensor(0.7)), torch.tensor([0.1, -0.2, 0.3])
    )


SOLIDS = [
    Box(base_from_object=_pose(), size=(0.3, 0.2, 0.1), label=1),
    Cylinder(base_from_object=_pose(), radius=0.08, height=0.25, label=2),
    Sphere(base_from_object=_pose(), radius=0.12, label=3),
    Turned(base_from_object=_pose(), profile=((0, -0.1), (0.1, -0.1), (0.06, 0.1), (0, 0.1)), label=4),
]
HOLLOW = [
    Turned(base_from_object=_pose(), profile=mug_profile(0.08, 0.2, 0.01), label=5),
    Turned(base_from_object=_pose(), profile=bowl_profile(0.15, 0.08, 0.01), label=6),
    Turned(base_from_object=_pose(), profile=bowl_profile(0.1, 0.15, 0.01), label=7),
]
each_solid = pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: type(solid).__name__)
each_solid_or_vessel = pytest.mark.parametrize("solid", [*SOLIDS, *HOLLOW])


def _rays(count: int = 4000) -> tuple[Tensor, Tensor]:
    """Rays from a sphere of radius 1 around the solid, toward points near it, of random lengths."""
    g = seeded(3)
    center = _pose()[:3, 3]
    origins = center + torch.nn.functional.normalize(torch.randn(count, 3, generator=g, dtype=torch.float64), dim=-1)
    targets = center + 0.25 * (2 * torch.rand(count, 3, generator=g, dtype=torch.float64) - 1)
    lengths = 0.1 + torch.rand(count, 1, generator=g, dtype=torch.float64)
    return origins, (targets - origins) * lengths


def _volume(solid: Shape) -> float:
    if isinstance(solid, Box):
        return math.prod(solid.size)
    if isinstance(solid, Cylinder):
        return math.pi * solid.radius**2 * solid.height
    if isinstance(solid, Turned):  # the frusta below its edges, those of downward edges taken away
        edges = zip(solid.profile, (*solid.profile[1:], solid.profile[0]))
        return sum(math.pi / 3 * (r * r + r * s + s * s) * (top - low) for (r, low), (s, top) in edges)
    assert isinstance(solid, Sphere)
    return 4 / 3 * math.pi * solid.radius**3


@each_solid_or_vessel
def test_hits_lie_on_the_surface_and_nothing_lies_before_them(solid: Shape) -> None:
    origins, directions = _rays()
    t, _ = solid.intersect(origins, directions)
    hit = torch.isfinite(t)
    assert 100 < int(hit.sum()) < len(t)
    assert float(solid.signed_distance((origins + t[:, None] * directions)[hit]).abs().max()) < 1e-12
    for part in torch.linspace(0.0, 0.999, 50):
        assert float(solid.signed_distance((origins + part * t[:, None] * directions)[hit]).min()) > 0


@each_solid_or_vessel
def test_a_miss_stays_outside_along_the_whole_ray(solid: Shape) -> None:
    origins, directions = _rays()
    missed = ~torch.isfinite(solid.intersect(origins, directions)[0])
    for t in torch.linspace(0.0, 20.0, 800, dtype=torch.float64):
        assert float(solid.signed_distance((origins + t * directions)[missed]).min()) > -1e-4


@each_solid
def test_normals_are_the_gradient_of_the_distance_and_face_the_ray(solid: Shape) -> None:
    origins, directions = _rays()
    t, normals = solid.intersect(origins, directions)
    hit = torch.isfinite(t)
    points, normals = (origins + t[:, None] * directions)[hit], normals[hit]
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(normals), dtype=torch.float64))
    assert float((normals * directions[hit]).sum(-1).max()) <= 0
    torch.testing.assert_close(solid.signed_distance(points + 0.01 * normals), torch.full_like(t[hit], 0.01))


@each_solid_or_vessel
def test_the_inside_has_the_solids_volume(solid: Shape) -> None:
    side = torch.linspace(-0.25, 0.25, 126, dtype=torch.float64)
    grid = _pose()[:3, 3] + torch.cartesian_prod(side, side, side)
    inside = int((solid.signed_distance(grid) < 0).sum()) * float(side[1] - side[0]) ** 3
    assert inside == pytest.approx(_volume(solid), rel=0.02)


@each_solid_or_vessel
def test_the_bounding_test_never_drops_a_hit(solid: Shape) -> None:
    origins, directions = _rays()
    kept = solid.may_hit(origins, directions)
    dropped = torch.ones(len(origins), dtype=torch.bool)
    dropped[kept] = False
    assert bool(dropped.any())
    assert not bool(torch.isfinite(solid.intersect(origins, directions)[0][dropped]).any())


@each_solid
def test_rays_from_inside_or_away_miss(solid: Shape) -> None:
    center = _pose()[None, :3, 3]
    directions = _rays()[1]
    assert not bool(torch.isfinite(solid.intersect(center, directions)[0]).any())
    origins = _rays()[0]
    assert not bool(torch.isfinite(solid.intersect(origins, origins - center)[0]).any())


def test_rays_along_the_axes_are_exact() -> None:
    upright = torch.eye(4, dtype=torch.float64)
    down = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    above = torch.tensor([[0.0, 0.0, 2.0], [0.0499, 0.0, 2.0], [0.0501, 0.0, 2.0]], dtype=torch.float64)
    for solid in (
        Box(base_from_object=upright, size=(0.1, 0.1, 0.4), label=1),
        Cylinder(base_from_object=upright, radius=0.05, height=0.4, label=1),
    ):
        t, normals = solid.intersect(above, down)
        torch.testing.assert_close(t, torch.tensor([1.8, 1.8, math.inf], dtype=torch.float64))
        torch.testing.assert_close(normals[:2], torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(2, 3))


def test_one_looks_into_a_mug_and_not_through_it() -> None:
    mug = Turned(base_from_object=torch.eye(4, dtype=torch.float64), profile=mug_profile(0.04, 0.1, 0.005), label=1)
    down = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    above = torch.tensor(
        [[0.0, 0.0, 1.0], [0.034, 0.0, 1.0], [0.0375, 0.0, 1.0], [0.041, 0.0, 1.0]], dtype=torch.float64
    )
    t, normals = mug.intersect(above, down)
    torch.testing.assert_close(t, torch.tensor([1.045, 1.045, 0.95, math.inf], dtype=torch.float64))
    torch.testing.assert_close(normals[:3], torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(3, 3))


def test_a_profile_must_run_counterclockwise_beside_the_axis() -> None:
    pose = torch.eye(4, dtype=torch.float64)
    for profile in (
        ((0, 0.1), (0.1, 0.1), (0.1, -0.1), (0, -0.1)),
        ((-0.1, 0), (0.1, 0), (0, 0.1)),
        ((0, 0), (0.1, 0.1)),
    ):
        with pytest.raises(ConfigError, match=r"Turned: profile needs .* counterclockwise"):
            Turned(base_from_object=pose, profile=profile, label=1)
