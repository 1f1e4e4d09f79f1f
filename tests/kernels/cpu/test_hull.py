"""The hull of many points by the compiled core: the corners of the reference, in its order."""

from __future__ import annotations

import pytest
import torch

from pcdata.contracts.dispatch import why_unavailable
from pcdata.functional.selection import hull_rows
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
