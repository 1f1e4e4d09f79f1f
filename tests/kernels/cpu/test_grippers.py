"""Points in grippers by the compiled core: the counts of the reference, whatever the cloud looks like."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pcdata.contracts.dispatch import why_unavailable
from pcdata.functional.grasps import points_in_grippers
from pcdata.rng import seeded

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason=str(why_unavailable("cpu")))


def grippers(count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Axes, origins and boxes within a cube of 30 cm, the first without a turn."""
    generator = seeded(count)
    axes = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))[0]
    axes[:1] = torch.eye(3, dtype=torch.float64)
    origin = 0.3 * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    lower = 0.05 * torch.rand(4, count, 3, generator=generator, dtype=torch.float64) - 0.1
    return axes, origin, lower, lower + 0.15 * torch.rand(4, count, 3, generator=generator, dtype=torch.float64)


def clouds() -> dict[str, Tensor]:
    """Clouds that a grid of cells could go wrong on."""
    cube = 0.3 * torch.rand(1500, 3, generator=seeded(0))
    flat, stray, line, copies = cube.clone(), cube.clone(), cube.clone(), cube.clone()
    flat[:, 2] = 0.1
    stray[0] = 1e6
    line[:, 1:] = 0.15
    copies[:] = 0.15
    return {"cube": cube, "flat": flat, "stray": stray, "line": line, "copies": copies, "none": cube[:0]}


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("name", clouds())
def test_counts_equal_the_reference(name, threads, monkeypatch):
    monkeypatch.setattr("pcdata.kernels.cpu.native.core_threads", lambda: threads)
    points, given = clouds()[name], grippers(75)
    own, expected = (points_in_grippers(points, *given, backend=backend) for backend in ("cpu", "torch"))
    assert all(map(torch.equal, own, expected))
    assert (len(points) == 0) == (int(expected[0].sum()) == 0)


def test_points_on_faces_count_as_the_reference_counts_them():
    steps = torch.arange(-4, 5) * 0.25
    points = torch.cartesian_prod(steps, steps, steps).float()
    axes, origin = torch.eye(3, dtype=torch.float64)[[2, 0, 1]][None], torch.zeros(1, 3, dtype=torch.float64)
    lower = torch.tensor([[-1.0, -0.5, -0.25], [0, -0.5, -0.25], [0, 0.25, -0.25], [0, -0.25, -0.25]])
    upper = torch.tensor([[0.0, 0.5, 0.25], [0.75, -0.25, 0.25], [0.75, 0.5, 0.25], [0.75, 0.25, 0.25]])
    lower, upper = lower.double()[:, None], upper.double()[:, None]
    hits, held = points_in_grippers(points, axes, origin, lower, upper, backend="cpu")
    assert hits.tolist() == [5 * 5 * 3 + 2 * 3 * 2 * 3]  # the palm, and two fingers without their face at the palm
    assert held.tolist() == [3 * 3 * 3]


def test_no_grasp_gives_no_count():
    hits, held = points_in_grippers(clouds()["cube"], *grippers(0), backend="cpu")
    assert hits.shape == held.shape == (0,)
