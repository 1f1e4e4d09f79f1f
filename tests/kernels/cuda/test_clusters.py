"""DBSCAN on a GPU: the reference's labels, whichever cells meet first."""

from __future__ import annotations

import pytest
import torch

from pcdata import functional as F
from pcdata.errors import ConfigError
from pcdata.rng import seeded
from tests.kernels.cuda import harness

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()


def agree(points, ptr=None, **options) -> torch.Tensor:
    found = F.dbscan(points, ptr, **options, backend=harness.BACKEND)
    assert torch.equal(found, F.dbscan(points, ptr, **options, backend="torch"))
    return found


@pytest.mark.parametrize("eps", [1e-3, 0.03, 0.08, 0.5])
@pytest.mark.parametrize("min_points", [1, 2, 5, 40, 10_000])
def test_clouds_at_random(eps, min_points, ordered):
    points = torch.rand(800, 3, generator=seeded(1))
    points[::3, 2] = 0.5
    points[9::11] = points[8::11][: len(points[9::11])]
    agree(points, torch.tensor([0, 0, 350, 351, 800]), eps=eps, min_points=min_points)


def test_chains_that_are_joined_link_by_link(ordered):
    places = torch.arange(400.0)[torch.randperm(400, generator=seeded(0))]
    line = torch.stack([places * 0.0099, (places * 0.1).sin() * 0.02, torch.zeros(400)], 1)
    assert int(agree(line, eps=0.0125, min_points=2).max()) < 3
    assert int(agree(line, eps=0.0098, min_points=1).max()) == 399


def test_crowded_cells_that_just_touch_and_just_do_not(ordered):
    blob = torch.rand(120, 3, generator=seeded(2)) * 0.004
    for gap in (0.0095, 0.0101):
        points = torch.cat([blob, blob + torch.tensor([0.004 + gap, 0, 0])])
        points = points[torch.randperm(240, generator=seeded(3))]
        agree(points, eps=0.01, min_points=6)


def test_borders_between_clusters_take_the_lowest_label(ordered):
    left = torch.tensor([[0.0, 0, 0]]).repeat(6, 1)
    right = torch.tensor([[0.019, 0, 0]]).repeat(6, 1)
    middle = torch.tensor([[0.0095, 0, 0]])
    for parts in ([left, middle, right], [right, left, middle], [middle, right, left]):
        agree(torch.cat(parts), eps=0.01, min_points=7)
        agree(torch.cat(parts), eps=0.01, min_points=14)


def test_an_extent_that_cells_cannot_have_is_refused():
    with pytest.raises(ConfigError, match="dbscan: a radius of"):
        F.dbscan(torch.tensor([[0.0, 0, 0], [1e9, 0, 0]]), eps=0.01, backend=harness.BACKEND)
