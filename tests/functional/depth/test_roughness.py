"""Roughness is 1 where only the stated noise is, on any plane; more where there is more."""

from __future__ import annotations

import pytest
import torch

from pcdata.functional.depth.roughness import depth_roughness
from pcdata.rng import seeded


def noisy_plane(tilt: tuple[float, float], sigma: float, size: int = 200) -> torch.Tensor:
    """1 / depth is linear in the pixel; noise is added to the depth."""
    v, u = torch.meshgrid(*2 * [torch.arange(size, dtype=torch.float64)], indexing="ij")
    depth = 1.0 / (1.0 + tilt[0] * u + tilt[1] * v)
    return (depth + sigma * torch.randn(size, size, generator=seeded(0)))[None]


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (1e-3, 5e-4), (-1e-3, 2e-3)])
@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_the_noise_is_measured_on_any_plane(tilt: tuple[float, float], factor: float):
    depth = noisy_plane(tilt, factor * 0.001)
    rough = depth_roughness(depth, torch.full_like(depth, 0.001), torch.full_like(depth, 0.1))
    assert float(rough[0, 10:-10, 10:-10].mean()) == pytest.approx(factor, rel=0.03)


def test_an_exact_plane_has_none():
    depth = noisy_plane((1e-3, 5e-4), 0.0)
    assert float(depth_roughness(depth, torch.full_like(depth, 0.001), torch.full_like(depth, 0.1)).max()) < 1e-6


@pytest.mark.parametrize("diagonal", [False, True])
def test_an_edge_is_no_roughness(diagonal: bool):
    depth = torch.ones(1, 30, 30, dtype=torch.float64)
    if diagonal:
        depth[0, torch.ones(30, 30, dtype=torch.bool).triu()] = 1.5
    else:
        depth[..., 15:] = 1.5
    assert float(depth_roughness(depth, torch.full_like(depth, 0.001), torch.full_like(depth, 0.05)).max()) == 0.0


def test_a_reading_at_odds_with_all_its_neighbors_fits_nowhere():
    depth = torch.ones(1, 9, 9, dtype=torch.float64)
    depth[0, 4, 4] = 1.5
    rough = depth_roughness(depth, torch.full_like(depth, 0.001), torch.full_like(depth, 0.05))
    assert torch.nonzero(rough.isinf()).tolist() == [[0, 4, 4]]


def test_a_lonely_reading_and_no_reading_are_not_judged():
    depth = torch.zeros(1, 9, 9, dtype=torch.float64)
    depth[0, 4, 4] = 1.0
    assert not bool(depth_roughness(depth, torch.full_like(depth, 0.001), torch.full_like(depth, 0.05)).any())
