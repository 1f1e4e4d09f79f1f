"""Flying pixels, against scenes that say which pixels are mixed."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from pcdata.errors import ConfigError
from pcdata.functional import flying_pixel_mask
from pcdata.rng import seeded
from pcdata.synthetic import SensorNoise, tabletop
from tests.factories import depth_edges


def counted(depth: torch.Tensor, tolerance: float, min_neighbors: int) -> torch.Tensor:
    """The rule for one image, a pixel at a time."""
    height, width = depth.shape
    mask = torch.zeros(depth.shape, dtype=torch.bool)
    for row, column in (depth > 0).nonzero().tolist():
        here, same, edge = depth[row, column], 0, 0
        for r in range(max(0, row - 1), min(height, row + 2)):
            for c in range(max(0, column - 1), min(width, column + 2)):
                other = depth[r, c]
                if (r, c) != (row, column) and other > 0:
                    on_surface = bool((here - other).abs() <= tolerance * torch.minimum(here, other))
                    same, edge = same + on_surface, edge + (not on_surface)
        mask[row, column] = edge > 0 and same < min_neighbors
    return mask


@pytest.mark.parametrize(("tolerance", "min_neighbors"), [(0.05, 3), (0.02, 1), (0.2, 8)])
def test_it_is_the_rule_pixel_by_pixel(tolerance, min_neighbors):
    depth = 1 + 0.1 * torch.randn(2, 13, 17, generator=seeded(0)).abs()
    depth[torch.rand(depth.shape, generator=seeded(1)) < 0.3] = 0
    found = flying_pixel_mask(depth, tolerance=tolerance, min_neighbors=min_neighbors)
    assert bool(found.any())
    for view in range(2):
        assert torch.equal(found[view], counted(depth[view], tolerance, min_neighbors))


@pytest.mark.parametrize(("seed", "flying", "dropout"), [(0, 0.1, 0.4), (1, 0.3, 0.2), (2, 0.5, 0.0)])
def test_mixed_pixels_go_and_good_ones_stay(seed, flying, dropout):
    noise = SensorNoise(flying_pixels=flying, edge_dropout=dropout)
    scene = tabletop(seed, num_objects=5, noise=noise)
    unmixed = tabletop(seed, num_objects=5, noise=dataclasses.replace(noise, flying_pixels=0.0)).frame.depth
    depth, truth = scene.frame.depth, scene.truth.depth
    across, _ = depth_edges(truth, 0.02)
    mixed = (depth > 0) & (depth != unmixed)
    # A mixture that is almost one of the two sides lies on that surface: nobody could tell it from a reading there.
    in_the_air = mixed & ((depth - truth).abs() > 0.02 * truth) & ((depth - across).abs() > 0.02 * across)
    good = (depth > 0) & ~mixed
    assert int(in_the_air.sum()) > 100

    removed = flying_pixel_mask(depth)
    assert float(removed[in_the_air].float().mean()) > 0.97, "recall of mixed pixels"
    assert float(removed[good].float().mean()) < 0.004, "good readings lost"


def test_a_slanted_plane_and_a_clean_edge_lose_nothing():
    u = torch.arange(60.0).expand(40, 60)
    slanted = 1 / (1 - 0.0075 * u)[None]  # a plane; from pixel to pixel 0.75 % to 1.3 %
    assert not bool(flying_pixel_mask(slanted).any())
    edge = torch.where(u < 30, 0.6, 1.2)[None]
    assert not bool(flying_pixel_mask(edge).any())


def test_a_reading_among_holes_stays_for_nothing_shows_that_it_flies():
    depth = torch.zeros(1, 5, 5)
    depth[0, 2, 2] = 1.0
    assert not bool(flying_pixel_mask(depth).any())
    depth[0, 2, 3] = 1.5
    assert int(flying_pixel_mask(depth).sum()) == 2


def test_bad_parameters_are_refused():
    for wrong in ({"tolerance": 0.0}, {"min_neighbors": 0}, {"min_neighbors": 9}):
        with pytest.raises(ConfigError, match=f"flying_pixel_mask: {next(iter(wrong))}"):
            flying_pixel_mask(torch.ones(1, 3, 3), **wrong)
