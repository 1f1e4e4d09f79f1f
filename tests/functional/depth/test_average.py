"""Averaging images of a still scene, against statistics and the truth of a rendered scene."""

from __future__ import annotations

import itertools

import pytest
import torch

from pcdata.errors import CaptureError, ConfigError, NonFiniteError, ShapeError
from pcdata.functional import average_depth
from pcdata.functional.depth.pixel_sort import network, pick_image, sort_images
from pcdata.rng import seeded
from pcdata.synthetic import tabletop
from tests.factories import depth_edges


def pixel(*readings: float) -> torch.Tensor:
    """T images of one pixel."""
    return torch.tensor(readings).reshape(-1, 1, 1, 1)


@pytest.mark.parametrize("count", range(1, 12))
def test_the_sorting_network_sorts_every_sequence_of_zeros_and_ones(count):
    # Which proves that it sorts everything: Knuth, The Art of Computer Programming 3, 5.3.4, theorem Z.
    for bits in itertools.product([0, 1], repeat=count):
        values = list(bits)
        for low, high in network(count):
            values[low], values[high] = sorted((values[low], values[high]))
        assert values == sorted(bits)


def test_images_are_sorted_pixel_by_pixel_and_picked_by_rank():
    images = torch.rand(9, 4, 5, generator=seeded(0))
    ordered = torch.stack(sort_images(images.unbind(0)))
    expected = images.sort(dim=0).values
    assert torch.equal(ordered, expected)
    rank = torch.arange(20).reshape(4, 5) % 9
    assert torch.equal(pick_image(ordered.unbind(0), rank), expected.gather(0, rank[None])[0])


def test_readings_are_averaged_and_holes_count_for_nothing():
    average = average_depth(pixel(1.000, 0.0, 1.002, 0.0, 1.004))
    assert average.depth.item() == pytest.approx(1.002, abs=1e-7)
    assert average.num_readings.item() == 3
    assert average.variance.item() == pytest.approx(torch.tensor([1.0, 1.002, 1.004]).double().var().item(), rel=1e-4)
    assert average.num_jitter.item() == 0


def test_mean_and_variance_are_those_of_torch_where_nothing_is_dropped():
    depths = 0.7 + 0.001 * torch.randn(8, 2, 30, 40, generator=seeded(1))
    average = average_depth(depths, mad_factor=100.0)
    torch.testing.assert_close(average.depth, depths.double().mean(0).float(), rtol=0, atol=2e-7)
    torch.testing.assert_close(average.variance, depths.double().var(0).float(), rtol=1e-3, atol=1e-9)
    assert bool((average.num_readings == 8).all())


def test_a_pixel_without_readings_has_none_afterwards():
    average = average_depth(pixel(0.0, 0.0, 0.0))
    assert [value.item() for value in average] == [0.0, 0, 0.0, 0, 0]


def test_a_reading_far_from_the_median_is_dropped_and_counted():
    average = average_depth(pixel(1.000, 1.001, 0.999, 1.000, 1.020, 1.500))
    assert average.depth.item() == pytest.approx(1.000, abs=1e-6)
    assert average.num_readings.item() == 4
    assert average.num_jitter.item() == 2
    assert average.num_jumps.item() == 1, "2 cm is jitter of this surface, half a metre is another surface"


@pytest.mark.parametrize(("near", "far", "expected"), [(6, 4, 0.8), (4, 6, 1.2), (5, 5, 0.8)])
def test_a_pixel_that_flickers_between_two_surfaces_takes_the_one_it_saw_more_often(near, far, expected):
    average = average_depth(pixel(*[0.8] * near, *[1.2] * far))
    assert average.depth.item() == pytest.approx(expected, abs=1e-6)
    assert average.num_jumps.item() == min(near, far)


def test_a_pixel_needs_min_count_readings():
    depths = torch.tensor([[1.0, 1.0, 1.0], [1.0, 1.0, 0.0], [1.0, 0.0, 0.0]])[:, None, None]
    assert average_depth(depths, min_count=2).depth.flatten().tolist() == [1.0, 1.0, 0.0]
    assert average_depth(depths, min_count=3).depth.flatten().tolist() == [1.0, 0.0, 0.0]
    assert average_depth(depths, min_count=3).num_readings.flatten().tolist() == [3, 2, 1]


def test_one_image_is_its_own_average():
    depth = torch.rand(1, 2, 5, 6, generator=seeded(2))
    average = average_depth(depth)
    assert torch.equal(average.depth, depth[0])
    assert not bool(average.variance.any())


def test_the_order_of_the_images_does_not_matter():
    depths = 0.7 + 0.004 * torch.randn(7, 1, 20, 20, generator=seeded(3))
    depths[torch.rand(depths.shape, generator=seeded(4)) < 0.2] = 0
    a, b = average_depth(depths), average_depth(depths[torch.randperm(7, generator=seeded(5))])
    torch.testing.assert_close(a.depth, b.depth, rtol=0, atol=2e-7)
    assert torch.equal(a.num_readings, b.num_readings)


@pytest.mark.parametrize("seed", [0, 1])
def test_ten_frames_cut_the_noise_to_a_third_and_do_not_move_edges(seed):
    scene = tabletop(seed, num_objects=5, noise="stereo", size=(240, 320), floor=False)
    depths = torch.stack([frame.depth for frame in scene.noisy_frames(10)])
    truth = scene.truth.depth.float()
    average = average_depth(depths)
    across, edge = depth_edges(truth.double(), 0.02)
    beside_edge = torch.nn.functional.max_pool2d(edge.float(), 5, 1, 2) > 0

    inside = ~beside_edge & (depths > 0).all(0)
    assert int(inside.sum()) > 25000
    before = (depths[:, inside] - truth[inside]).square().mean().sqrt()
    after = (average.depth - truth)[inside].square().mean().sqrt()
    assert float(before / after) >= 3.0  # the square root of ten, 3.16, is what an average can do

    at_edge = edge & (average.depth > 0)
    on_own_side = (average.depth - truth).abs() <= 0.02 * truth
    on_other_side = (average.depth - across).abs() <= 0.02 * across
    assert float(on_own_side[at_edge].float().mean()) > 0.99
    single = edge & (depths[0] > 0)
    lost = ~(on_own_side | on_other_side)[at_edge]
    torn = ((depths[0] - truth).abs() > 0.02 * truth) & ((depths[0] - across).abs() > 0.02 * across)
    assert float(lost.float().mean()) < 0.25 * float(torn[single].float().mean()), "fewer depths between surfaces"
    assert float((average.depth > 0).float().mean()) > float((depths[0] > 0).float().mean()), "and fewer holes"


def test_bad_images_and_limits_are_refused():
    with pytest.raises(ShapeError, match="depths must be"):
        average_depth(torch.ones(2, 3, 4))
    with pytest.raises(ShapeError, match="at least one image"):
        average_depth(torch.ones(0, 1, 3, 4))
    with pytest.raises(CaptureError, match="negative"):
        average_depth(pixel(1.0, -1.0))
    with pytest.raises(NonFiniteError, match="depths has 1 NaN"):
        average_depth(pixel(1.0, torch.nan))
    for wrong in ({"mad_factor": 0.0}, {"resolution": -1.0}, {"max_jump": 0.0}, {"min_count": 0}):
        with pytest.raises(ConfigError, match="average_depth: needs"):
            average_depth(pixel(1.0), **wrong)
