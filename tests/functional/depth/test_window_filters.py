"""Windows of depth against kornia, OpenCV and loops over pixels in float64."""

from __future__ import annotations

import math

import cv2
import kornia
import numpy as np
import pytest
import torch
from torch import Tensor

from pcdata.errors import CaptureError, ConfigError
from pcdata.functional.depth.window_filters import bilateral_filter, median_filter
from pcdata.rng import seeded


def steps(seed: int = 0, *, holes: float = 0.2, noise: float = 0.002) -> Tensor:
    """(2, 20, 26) metres: a slanted floor, a box on it 10 % nearer, noise and holes."""
    draw = seeded(seed)
    depth = 0.8 + 0.004 * torch.arange(20.0)[None, :, None].expand(2, 20, 26)
    depth = depth.clone()
    depth[:, 6:14, 8:17] *= 0.9
    depth += noise * torch.randn(depth.shape, generator=draw)
    return torch.where(torch.rand(depth.shape, generator=draw) < holes, 0.0, depth)


def windows(depth: Tensor, reach: int, max_jump: float):
    """Yield view, row, column, the pixel and the readings on its surface with their places, pixel by pixel."""
    array = depth.double().numpy()
    views, height, width = array.shape
    for v in range(views):
        for y in range(height):
            for x in range(width):
                z, near = array[v, y, x], []
                for other_y in range(max(0, y - reach), min(height, y + reach + 1)):
                    for other_x in range(max(0, x - reach), min(width, x + reach + 1)):
                        other = array[v, other_y, other_x]
                        if z > 0 and other > 0 and abs(z - other) <= max_jump * min(z, other):
                            near.append((other_y - y, other_x - x, other))
                yield (v, y, x), z, near


def bilateral_by_loops(depth: Tensor, reach: int, sigma: float, sigma_depth: float, max_jump: float) -> np.ndarray:
    found = np.zeros(depth.shape)
    for place, z, near in windows(depth, reach, max_jump):
        weights = [
            math.exp(-(dy * dy + dx * dx) / (2 * sigma**2) - (z - other) ** 2 / (2 * sigma_depth**2))
            for dy, dx, other in near
        ]
        if near:
            found[place] = sum(w * other for w, (_, _, other) in zip(weights, near)) / sum(weights)
    return found


@pytest.mark.parametrize(("reach", "sigma", "max_jump"), [(1, 0.8, 0.02), (2, 1.5, 0.05), (3, 2.0, 1e9)])
def test_the_bilateral_filter_is_its_formula(reach, sigma, max_jump):
    depth = steps()
    found = bilateral_filter(depth, reach=reach, sigma_pixels=sigma, sigma_depth=0.005, max_jump=max_jump)
    expected = bilateral_by_loops(depth, reach, sigma, 0.005, max_jump)
    np.testing.assert_allclose(found.numpy(), expected, atol=2e-7)


def test_without_holes_and_edges_it_is_kornias():
    depth = steps(holes=0.0)
    theirs = kornia.filters.bilateral_blur(depth[:, None], (5, 5), 0.01, (1.5, 1.5))[:, 0]
    ours = bilateral_filter(depth, reach=2, sigma_pixels=1.5, sigma_depth=0.01, max_jump=math.inf)
    torch.testing.assert_close(ours[:, 2:-2, 2:-2], theirs[:, 2:-2, 2:-2], atol=1e-6, rtol=0)


@pytest.mark.parametrize("reach", [1, 2])
def test_the_median_without_holes_is_opencvs(reach):
    depth = steps(holes=0.0)
    ours = median_filter(depth, reach=reach)
    inside = slice(reach, -reach)
    for view, mine in zip(depth, ours):
        theirs = cv2.medianBlur(view.numpy(), 2 * reach + 1)
        np.testing.assert_array_equal(mine.numpy()[inside, inside], theirs[inside, inside])


@pytest.mark.parametrize(("reach", "max_jump"), [(1, None), (1, 0.03), (2, 0.03), (3, None)])
def test_the_median_is_the_lower_middle_reading_of_the_window(reach, max_jump):
    depth = steps(1, holes=0.4)
    found = median_filter(depth, reach=reach, max_jump=max_jump)
    for place, z, near in windows(depth, reach, math.inf if max_jump is None else max_jump):
        values = sorted(other for _, _, other in near)
        assert float(found[place]) == (values[(len(values) - 1) // 2] if z > 0 else 0.0)


@pytest.mark.parametrize("function", [bilateral_filter, median_filter])
def test_nothing_is_blended_across_an_edge_and_holes_stay(function):
    depth = steps(noise=0.0)
    filtered = function(depth, reach=3, max_jump=0.05)
    assert torch.equal(filtered == 0, depth == 0)
    there = depth > 0
    assert float(((filtered - depth).abs() / depth.clamp(min=0.1))[there].max()) < 0.02  # the slant in a window
    box = torch.zeros_like(there)
    box[:, 6:14, 8:17] = True
    assert float(filtered[there & box].max()) < float(filtered[there & ~box].min()) + 0.1
    assert bool((filtered[there & box] < 0.8).all())


def test_a_median_of_the_window_removes_lone_readings_and_one_of_the_surface_keeps_them():
    depth = torch.full((1, 9, 9), 1.0)
    depth[0, 4, 4] = 0.5
    assert bool((median_filter(depth) == 1.0).all())
    assert torch.equal(median_filter(depth, max_jump=0.05), depth)


def test_noise_falls_and_edges_stand():
    clean = torch.full((1, 60, 80), 0.8)
    clean[:, 20:40, 30:50] = 0.72
    noisy = clean + 0.002 * torch.randn(clean.shape, generator=seeded(3))
    before = float((noisy - clean).square().mean().sqrt())
    for filtered, part in (
        (bilateral_filter(noisy, reach=2, sigma_pixels=2.0, sigma_depth=0.01), 0.5),
        (median_filter(noisy, reach=1, max_jump=0.05), 0.7),
    ):
        assert float((filtered - clean).square().mean().sqrt()) < part * before


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e30])
def test_sigmas_of_any_size_give_finite_means(scale):
    depth = steps() * scale
    for sigma in (5e-324, 1e-200, 1e-9, 1e9, 1e200):
        found = bilateral_filter(depth, sigma_depth=sigma, sigma_pixels=sigma, max_jump=math.inf)
        assert bool(found.isfinite().all())
        if sigma <= 1e-200:  # nothing but the pixel itself weighs
            assert torch.equal(found, depth)


@pytest.mark.parametrize("function", [bilateral_filter, median_filter])
def test_wrong_input_is_told(function):
    name = function.__name__
    with pytest.raises(ConfigError, match=f"{name}: reach must be 1 to"):
        function(steps(), reach=8)
    with pytest.raises(ConfigError, match=f"{name}: max_jump"):
        function(steps(), max_jump=-0.1)
    with pytest.raises(CaptureError, match=f"{name}: depth"):
        function(-steps())
    assert function(torch.zeros(1, 0, 5)).shape == (1, 0, 5)
