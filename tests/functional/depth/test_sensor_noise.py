"""The pieces of the sensor model: slopes of known planes, neighbors across jumps, disparity errors."""

from __future__ import annotations

import math

import pytest
import torch

from pcdata.functional.depth.sensor_noise import err_in_disparity, facing_depth, quantized, surface_slope

FOCAL = torch.full((1, 1, 1), 500.0, dtype=torch.float64)


def tilted_plane(degrees: float, vertical: bool = False) -> torch.Tensor:
    """Depth of a plane through (0, 0, 1 m), turned about the image's vertical (or horizontal) axis."""
    ray = (torch.arange(81, dtype=torch.float64) - 40) / 500
    depth = 1.0 / (1.0 - math.tan(math.radians(degrees)) * ray)
    return (depth[:, None] if vertical else depth).expand(81, 81)[None].clone()


@pytest.mark.parametrize("vertical", [False, True])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0, 75.0])
def test_the_slope_of_a_plane_is_the_tangent_of_its_tilt(degrees: float, vertical: bool):
    slope = surface_slope(tilted_plane(degrees, vertical), FOCAL)
    # The flatter side is the nearer one: over 3 pixels of 1/500 the perspective makes it less by this part.
    expected = math.tan(math.radians(degrees))
    assert float(slope[0, 40, 40]) == pytest.approx(expected, rel=3 / 500 * expected + 1e-6, abs=1e-9)


def test_a_jump_is_no_slope_and_the_border_has_none_to_one_side():
    depth = torch.ones(1, 20, 20, dtype=torch.float64)
    depth[..., 10:] = 2.0
    assert float(surface_slope(depth, FOCAL).max()) == 0.0


def test_what_noise_can_explain_is_no_slope():
    depth = tilted_plane(45.0)
    step = 3 * 1.0 / 500  # metres that 3 pixels of a 45 degree plane rise at 1 m
    assert float(surface_slope(depth, FOCAL, tolerance=2 * step)[0, 40, 40]) == 0.0


def test_pixels_without_readings_around_have_no_slope():
    depth = torch.zeros(1, 9, 9, dtype=torch.float64)
    depth[0, 4, 4] = 1.0
    assert not bool(surface_slope(depth, FOCAL).any())


def test_the_neighbor_across_the_largest_jump_is_found():
    depth = torch.tensor([[[1.0, 1.0, 1.2], [1.0, 1.1, 3.0], [1.0, 1.0, 1.0]]])
    assert facing_depth(depth)[0, 1].tolist() == pytest.approx([1.1, 3.0, 1.0])


def test_no_disparity_is_no_depth():
    depth = torch.tensor([[[10.0, 1.0]]], dtype=torch.float64)
    wobble = torch.full((1, 1, 2), -3.0)
    measured = err_in_disparity(depth, wobble, focal_baseline=FOCAL * 0.05, sigma=1.0, step=0.0)
    assert measured[0, 0].tolist() == pytest.approx([0.0, 25.0 / 22.0])  # disparities -0.5 and 25 - 3


def test_a_step_of_zero_rounds_nothing():
    values = torch.rand(5)
    assert quantized(values, 0.0) is values
    assert quantized(torch.tensor([0.26, 0.24]), 0.5).tolist() == [0.5, 0.0]
