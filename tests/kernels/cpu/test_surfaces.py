"""The surface of a table by the compiled core: that of the reference, but for the order in which sums are added."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pcdata.contracts.dispatch import why_unavailable
from pcdata.errors import NoPlaneError
from pcdata.functional.surface_fit import SAMPLE, fit_surface, reaches
from pcdata.rng import seeded

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason=str(why_unavailable("cpu")))

PLANE = torch.tensor([0.0, 0.6, 0.8, -0.9], dtype=torch.float64)
SENSOR = torch.zeros(1, 3, dtype=torch.float64)


def bent_table(count: int, clutter: float, noise: float = 0.002) -> Tensor:
    """Points (count, 3) of a bent table, a share of them anywhere around it."""
    generator = seeded(count)
    s, t = torch.rand(2, count, generator=generator) - 0.5
    height = 0.01 * s * s + noise * torch.randn(count, generator=generator)
    astray = torch.rand(count, generator=generator) < clutter
    height = torch.where(astray, 0.2 * torch.rand(count, generator=generator) - 0.1, height)
    along, across = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.8, -0.6])
    foot = -PLANE[3].float() * PLANE[:3].float()
    return foot + s[:, None] * along + t[:, None] * across + height[:, None] * PLANE[:3].float()


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("clutter", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("count", [60, 1001, 2 * SAMPLE + 5])
def test_surfaces_are_those_of_the_reference(count, clutter, threads, monkeypatch):
    monkeypatch.setattr("pcdata.kernels.cpu.native.core_threads", lambda: threads)
    points, ptr = bent_table(count, clutter), torch.tensor([0, count])
    reach, plain = (reaches(points, ptr, SENSOR, 0.01, backend=backend) for backend in ("cpu", "torch"))
    torch.testing.assert_close(reach, plain, rtol=1e-15, atol=0)  # roots differ in the last digit
    own, expected = (fit_surface(points, reach, PLANE, 0.01, "here", backend=backend) for backend in ("cpu", "torch"))
    torch.testing.assert_close(own.height, expected.height, rtol=0, atol=1e-12)
    assert own[1:] == pytest.approx(expected[1:], rel=1e-9)


def test_a_flat_table_without_noise_has_the_least_that_is_believed():
    s, t = torch.cartesian_prod(torch.linspace(-0.5, 0.5, 15), torch.linspace(-0.5, 0.5, 15)).unbind(1)
    points = torch.stack([s, t, torch.full_like(s, 0.25)], 1)
    level = torch.tensor([0.0, 0.0, 1.0, -0.25], dtype=torch.float64)
    for backend in ("cpu", "torch"):
        found = fit_surface(points, torch.ones(225, dtype=torch.float64), level, 0.01, "here", backend=backend)
        assert float(found.height.abs().max()) < 1e-12
        assert found.noise == pytest.approx(0.05 * 0.01)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_planes_with_nothing_near_are_refused(count):
    points = bent_table(count, 0.0) + (0.0 if count < 3 else 5.0)
    reach = torch.ones(count, dtype=torch.float64)
    for backend in ("cpu", "torch"):
        with pytest.raises(NoPlaneError, match=f"here: the plane has {count if count < 3 else 0} points nearer"):
            fit_surface(points, reach, PLANE, 0.01, "here", backend=backend)


def test_distances_are_from_the_place_of_a_cloud_or_of_a_point():
    points, ptr = torch.rand(70, 3, generator=seeded(0)), torch.tensor([0, 30, 30, 70])
    places = torch.rand(3, 3, generator=seeded(1), dtype=torch.float64)
    own = reaches(points, ptr, places, 0.3, backend="cpu")
    torch.testing.assert_close(own, reaches(points, ptr, places, 0.3, backend="torch"), rtol=1e-15, atol=0)
    assert float(own.min()) == 0.3
    each = places.repeat_interleave(torch.tensor([30, 0, 40]), 0)
    assert torch.equal(own, reaches(points, ptr, each, 0.3, backend="cpu"))
    expected = torch.linalg.vector_norm(points.double() - each, dim=1).clamp(min=0.3)
    torch.testing.assert_close(own, expected, rtol=1e-15, atol=0)
