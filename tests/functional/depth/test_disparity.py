"""Disparity and the spatial filter, against its recursion written out and known surfaces."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata.errors import CaptureError, ConfigError
from pcdata.functional import depth_to_disparity, disparity_to_depth, spatial_filter
from pcdata.rng import seeded

FOCAL = torch.tensor([600.0], dtype=torch.float64)


def recursion(image: np.ndarray, alpha: float, delta: float, iterations: int) -> np.ndarray:
    """The filter one pixel at a time, in float64."""

    def along(line: np.ndarray) -> np.ndarray:
        raw, out = line.copy(), line.copy()
        for place in range(1, len(line)):
            previous, current = raw[place - 1], raw[place]
            if previous > 0 and current > 0 and abs(current - previous) < delta:
                out[place] = alpha * current + (1 - alpha) * out[place - 1]
        return out

    def forth_and_back(line: np.ndarray) -> np.ndarray:
        return along(along(line)[::-1])[::-1]

    for _ in range(iterations):
        image = np.apply_along_axis(forth_and_back, 1, image)
        image = np.apply_along_axis(forth_and_back, 0, image)
    return image


def test_disparity_is_in_steps_of_a_32nd_pixel():
    depth = torch.tensor([[[1.0, 0.5, 0.0]]])
    disparity = depth_to_disparity(depth, FOCAL, 0.05)
    assert disparity.flatten().tolist() == pytest.approx([32 * 30, 32 * 60, 0.0])  # f b / z = 30 pixels at 1 m


def test_depth_survives_the_way_to_disparity_and_back():
    depth = torch.rand(2, 20, 30, generator=seeded(0)) * 5 + 0.2
    depth[0, :5] = 0
    focal = torch.tensor([600.0, 400.0])
    back = disparity_to_depth(depth_to_disparity(depth, focal, 0.05), focal, 0.05)
    torch.testing.assert_close(back, depth, rtol=3e-7, atol=0)


@pytest.mark.parametrize("alpha", [0.25, 0.5, 0.9])
@pytest.mark.parametrize(("delta", "iterations"), [(20.0, 2), (3.0, 1), (1000.0, 3)])
def test_it_is_the_recursion_pixel_by_pixel(alpha, delta, iterations):
    image = 900 + 15 * torch.randn(14, 19, generator=seeded(1))
    image[:, 9:] += 60
    image[torch.rand(image.shape, generator=seeded(2)) < 0.15] = 0
    expected = recursion(image.double().numpy(), alpha, delta, iterations)
    found = spatial_filter(image[None], alpha=alpha, delta=delta, iterations=iterations)[0]
    torch.testing.assert_close(found.double(), torch.from_numpy(expected.copy()), rtol=1e-6, atol=0)


def test_noise_on_a_slanted_plane_goes_down_and_its_edge_stays_where_it_is():
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    truth = 800 + 0.5 * u + 0.3 * v + torch.where(u < 80, 0.0, 100.0)
    noise = 2.5 * torch.randn(truth.shape, generator=seeded(3))
    found = spatial_filter((truth + noise)[None])[0]
    error = (found - truth)[5:-5, 5:-5]
    assert float(error.std()) < 0.5 * float(noise.std())
    side = found > truth - torch.where(u < 80, 0.0, 100.0) + 50
    assert torch.equal(side, u >= 80), "no pixel changed sides"
    assert float(error[:, 70:80].abs().max()) < 10, "and none was drawn toward the other side"


def test_without_a_threshold_holes_are_edges_all_the_same():
    image = torch.tensor([[[4.0, 6.0, 0.0, 10.0]]])
    found = spatial_filter(image, alpha=0.5, delta=torch.inf, iterations=1)
    assert found.flatten().tolist() == [4.5, 5.0, 0.0, 10.0]  # forth: 4, 5; back: (4 + 5) / 2


def test_holes_stay_holes_and_nothing_passes_through_them():
    image = torch.full((1, 9, 20), 500.0)
    image[..., 8:11] = 0
    image[..., 11:] = 505.0
    found = spatial_filter(image, iterations=5)
    assert torch.equal(found == 0, image == 0)
    torch.testing.assert_close(found, image)


def test_alpha_one_changes_nothing():
    image = torch.rand(2, 8, 9, generator=seeded(4)) * 100
    assert torch.equal(spatial_filter(image, alpha=1.0), image)


def test_a_step_of_delta_is_an_edge_and_a_smaller_one_is_not():
    image = torch.tensor([[[100.0, 120.0]]])
    assert torch.equal(spatial_filter(image, delta=20.0), image)
    assert not torch.equal(spatial_filter(image, delta=20.1), image)


def test_bad_parameters_and_images_are_refused():
    image = torch.ones(1, 3, 3)
    for wrong in ({"alpha": 0.0}, {"alpha": 1.1}, {"delta": 0.0}, {"iterations": 0}):
        with pytest.raises(ConfigError, match=f"spatial_filter: {next(iter(wrong))}"):
            spatial_filter(image, **wrong)
    with pytest.raises(CaptureError, match="negative"):
        spatial_filter(-image)
    with pytest.raises(ConfigError, match="baseline"):
        depth_to_disparity(image, FOCAL, 0.0)
    with pytest.raises(CaptureError, match="depth_to_disparity: depth must be"):
        depth_to_disparity(-image, FOCAL, 0.05)
