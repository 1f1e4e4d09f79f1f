"""Radius outliers by cells: clouds that decide nothing beside a row, crowded and lonely cells, any extent."""

from __future__ import annotations

import pytest
import torch

from pcdata import functional as F
from pcdata.errors import ConfigError
from pcdata.rng import seeded
from tests.kernels.cuda import harness

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()


def agree(points: torch.Tensor, ptr: torch.Tensor | None = None, **arguments: float) -> torch.Tensor:
    found = F.radius_outlier_mask(points, ptr, backend=harness.BACKEND, **arguments)
    assert torch.equal(found, F.radius_outlier_mask(points, ptr, backend="torch", **arguments))
    return found


@pytest.mark.parametrize("radius", [1e-3, 0.02, 0.05, 0.3, 4.0])
@pytest.mark.parametrize("enough", [1, 4, 60, 10_000])
def test_clouds_at_random(radius, enough, ordered):
    points = torch.rand(900, 3, generator=seeded(3))
    points[::3, 2] = 0.5
    points[7::9] = points[6::9][: len(points[7::9])]
    agree(points, torch.tensor([0, 0, 300, 301, 900]), radius=radius, min_neighbors=enough)


@pytest.mark.parametrize("enough", [3, 8])
def test_points_on_the_borders_of_cells_and_just_within_reach(enough, ordered):
    radius = 0.01
    side = radius / 3**0.5 * (1 - 1e-4)
    steps = torch.arange(-3, 4) * side
    points = torch.cartesian_prod(steps, steps, steps).float()
    found = agree(points[torch.randperm(len(points), generator=seeded(0))], radius=radius, min_neighbors=enough)
    assert found.any() or enough == 3
    ring = torch.eye(3).repeat(2, 1) * radius
    ring[3:] *= -1
    agree(torch.cat([torch.zeros(1, 3), ring, ring * (1 - 1e-6)]), radius=radius, min_neighbors=enough)


def test_clouds_far_from_their_origin_and_from_one_another(ordered):
    near = torch.rand(200, 3, generator=seeded(1)) * 0.05
    agree(torch.cat([near, near + 4000.0, near - 9e5]), radius=0.02, min_neighbors=4)
    agree(torch.cat([near, near + 9e5]), torch.tensor([0, 200, 400]), radius=0.02, min_neighbors=4)


def test_an_extent_that_cells_cannot_have_is_refused_as_by_the_reference():
    points = torch.tensor([[0.0, 0, 0], [1e9, 0, 0], [0, 1, 0]])
    with pytest.raises(ConfigError, match=r"radius_outlier_mask: a radius of 0\.01 cuts a cloud into"):
        F.radius_outlier_mask(points, radius=0.01, backend=harness.BACKEND)
    points[1, 0] = 3e8  # far enough to be asked about, and allowed
    agree(points, radius=0.01, min_neighbors=1)


def test_one_wait_for_the_device_and_few_launches(monkeypatch):
    from tests import pretend_device
    from tests.pretend_device import watching

    if not pretend_device.AVAILABLE:
        pytest.skip("this PyTorch has no devices written in Python")
    device = harness.as_on_a_gpu(monkeypatch)
    points = torch.rand(500, 3, generator=seeded(2)).to(device)
    ptr = torch.tensor([0, 500]).to(device)
    F.radius_outlier_mask(points, ptr, radius=0.05)
    with watching() as watched:
        F.radius_outlier_mask(points, ptr, radius=0.05)
    assert watched.waits.total() == 1, watched.waits
    assert watched.launches < 25
