"""RandomElastic: a smooth bending that belongs to places, not to points."""

from __future__ import annotations

import json

import pytest
import torch

from pcdata import transforms as T
from pcdata.errors import ConfigError
from pcdata.functional.elastic import lattice_offsets
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from tests.factories import cloud_in_base


def offsets_of(points: torch.Tensor, seed: int = 3, wavelength: float = 0.2) -> tuple[torch.Tensor, torch.Tensor]:
    ptr = torch.tensor([0, len(points)])
    return lattice_offsets(points, ptr, torch.tensor([seed]), wavelength)


def test_the_slopes_are_the_derivatives_of_the_offsets():
    points = torch.randn(60, 3, generator=seeded(1), dtype=torch.float64)
    _, slopes = offsets_of(points)
    step = 1e-6
    for axis in range(3):
        aside = step * torch.eye(3, dtype=torch.float64)[axis]
        difference = (offsets_of(points + aside)[0] - offsets_of(points - aside)[0]) / (2 * step)
        torch.testing.assert_close(slopes[:, :, axis], difference, atol=1e-6, rtol=1e-5)


def test_offsets_fill_their_range_and_are_smooth_across_cells():
    nodes = torch.randint(-400, 400, (3000, 3), generator=seeded(2)).double() * 0.2
    drawn, slopes = offsets_of(nodes)
    assert float(drawn.abs().max()) <= 1
    assert abs(float(drawn.mean())) < 4 / (3 * 9000) ** 0.5
    assert abs(float(drawn.square().mean()) - 1 / 3) < 0.02
    assert float((torch.corrcoef(drawn.T) - torch.eye(3)).abs().max()) < 0.08
    assert float(slopes.abs().max()) < 1e-9  # flat at every node
    line = torch.zeros(20001, 3, dtype=torch.float64)
    line[:, 0] = torch.linspace(-1.0, 1.0, 20001, dtype=torch.float64)
    along, _ = offsets_of(line)
    assert float(along.diff(dim=0).abs().max()) <= 1.001 * 3.0 / 0.2 * 1e-4


def test_a_place_is_bent_alike_whatever_else_is_in_the_cloud():
    data = cloud_in_base((80,))
    step = T.RandomElastic()
    result = step(data, generator=seeded(4))
    assert float((result.points - data.points).abs().max()) <= step.max_offset * (1 + 1e-6)
    assert not torch.allclose(result.points, data.points, atol=1e-3)
    half = data.select(torch.arange(0, 80, 2), torch.tensor([0, 40]))
    again = step.replay(half, json.loads(json.dumps(list(result.history))))
    assert torch.equal(again.points, result.points[::2])
    assert torch.equal(again.normals, result.normals[::2])


def test_normals_of_a_bent_plane_are_those_of_its_bent_directions():
    places = torch.rand(40, 2, generator=seeded(5))
    points = torch.cat([places, 0.3 * places[:, :1]], 1)
    normal = torch.nn.functional.normalize(torch.tensor([[-0.3, 0.0, 1.0]]), dim=1)
    step = T.RandomElastic(wavelength=0.3, max_offset=0.03)
    aside = 1e-3 * torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.3], [0.0, 1.0, 0.0]])
    every = (points[:, None] + aside).reshape(-1, 3)
    cloud = PointCloud(points=every, normals=normal.repeat(120, 1), frame_id="base")
    bent = step(cloud, generator=seeded(6))
    at, one, other = bent.points.double().reshape(40, 3, 3).unbind(1)
    expected = torch.nn.functional.normalize(torch.linalg.cross(one - at, other - at), dim=1)
    assert float((bent.normals[::3].double() - expected).norm(dim=1).max()) < 0.01
    assert float((expected - normal.double()).norm(dim=1).max()) > 0.1
    assert float((bent.normals.norm(dim=1) - 1).abs().max()) < 1e-6


def test_nothing_folds_over():
    step = T.RandomElastic(wavelength=0.18, max_offset=0.0199)
    points = torch.randn(4000, 3, generator=seeded(7), dtype=torch.float64)
    _, slopes = offsets_of(points, wavelength=0.18)
    bend = torch.eye(3, dtype=torch.float64) + step.max_offset * slopes
    assert float(torch.linalg.det(bend).min()) > 0
    for wrong in (0.02, 0.1):
        with pytest.raises(ConfigError, match="less than a ninth of the wavelength"):
            T.RandomElastic(wavelength=0.18, max_offset=wrong)
