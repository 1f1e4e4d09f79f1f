"""Decimation and resizing, against OpenCV, plain loops and geometry."""

from __future__ import annotations

import statistics

import pytest
import torch

from pcdata.errors import CaptureError, ConfigError, ShapeError
from pcdata.functional import decimate_depth, deproject_depth, resize_depth
from pcdata.rng import seeded
from pcdata.structures import Camera


def noisy_image(height: int, width: int, *, holes: float = 0.3, seed: int = 0) -> torch.Tensor:
    depth = 0.5 + torch.rand(2, height, width, generator=seeded(seed))
    return torch.where(torch.rand(depth.shape, generator=seeded(seed + 1)) < holes, 0.0, depth)


def blocks(depth: torch.Tensor, factor: int) -> torch.Tensor:
    """(V, h, w, factor * factor) in row-major order."""
    tiles = depth.unfold(1, factor, factor).unfold(2, factor, factor)
    return tiles.reshape(*tiles.shape[:3], factor * factor)


@pytest.mark.parametrize("factor", range(1, 9))
def test_a_block_becomes_the_median_of_its_readings(factor):
    depth = noisy_image(25, 34)
    reduced, _ = decimate_depth(depth, factor=factor, max_jump=10.0)
    for place, block in enumerate(blocks(depth, factor).flatten(0, 2).tolist()):
        readings = [value for value in block if value > 0]
        expected = statistics.median(readings) if readings else 0.0
        assert reduced.flatten()[place].item() == pytest.approx(expected, rel=2e-7)


@pytest.mark.parametrize("factor", range(1, 9))
def test_where_the_middle_two_are_two_surfaces_a_block_becomes_the_nearer(factor):
    depth = noisy_image(25, 34)
    reduced, pixel_index = decimate_depth(depth, factor=factor, max_jump=1e-9)
    assert reduced.shape == (2, 25 // factor, 34 // factor)
    for place, block in enumerate(blocks(depth, factor).flatten(0, 2).tolist()):
        readings = [value for value in block if value > 0]
        assert reduced.flatten()[place].item() == (statistics.median_low(readings) if readings else 0.0)
    chosen = depth.flatten(1).gather(1, pixel_index.flatten(1)).reshape(reduced.shape)
    assert torch.equal(chosen, reduced)


@pytest.mark.parametrize("factor", [2, 5])
def test_the_mean_is_that_of_the_readings_alone(factor):
    depth = noisy_image(20, 30)
    reduced, pixel_index = decimate_depth(depth, factor=factor, rule="mean")
    tiles = blocks(depth, factor).double()
    expected = tiles.sum(-1) / (tiles > 0).sum(-1).clamp(min=1)
    torch.testing.assert_close(reduced, expected.float())
    assert torch.equal(pixel_index, decimate_depth(depth, factor=factor)[1])


def test_a_block_without_a_reading_points_at_its_middle():
    reduced, pixel_index = decimate_depth(torch.zeros(1, 6, 9), factor=3)
    assert not bool(reduced.any())
    assert pixel_index.tolist() == [[[10, 13, 16], [37, 40, 43]]]


def test_equal_depths_are_taken_from_the_first_pixel():
    _, pixel_index = decimate_depth(torch.ones(1, 2, 2), factor=2)
    assert pixel_index.item() == 1  # the lower median of four is the second


def test_the_median_never_mixes_two_surfaces():
    depth = torch.where(torch.arange(32) < 13, 0.5, 1.0).expand(1, 24, 32).contiguous()
    for factor in range(2, 9):
        assert set(decimate_depth(depth, factor=factor)[0].flatten().tolist()) <= {0.5, 1.0}
    assert set(decimate_depth(depth, factor=8, rule="mean")[0].flatten().tolist()) - {0.5, 1.0}, "the mean does"


@pytest.mark.parametrize("size", [(12, 17), (50, 68), (25, 34), (7, 100), (1, 1), (24, 33)])
def test_nearest_is_that_of_opencv(size):
    cv2 = pytest.importorskip("cv2")
    depth = noisy_image(25, 34)
    resized, pixel_index = resize_depth(depth, size=size)
    for view in range(2):
        expected = cv2.resize(depth[view].numpy(), size[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
        assert torch.equal(resized[view], torch.from_numpy(expected).reshape(size))
    assert torch.equal(depth.flatten(1).gather(1, pixel_index.flatten(1)).reshape(resized.shape), resized)


@pytest.mark.parametrize("size", [(40, 57), (17, 23)])
@pytest.mark.parametrize("max_jump", [None, 0.5])
def test_the_resized_depth_with_resized_intrinsics_lies_on_the_same_plane(size, max_jump):
    camera = Camera.pinhole(fx=40.0, fy=42.0, cx=16.0, cy=11.0, size=(25, 34))
    normal, offset = torch.tensor([0.3, -0.2, 0.93], dtype=torch.float64), 0.8
    v, u = torch.meshgrid(torch.arange(25.0), torch.arange(34.0), indexing="ij")
    rays = torch.stack([(u - 16) / 40, (v - 11) / 42, torch.ones_like(u)], dim=-1).double()
    depth = (offset / (rays @ normal)).float()[None]
    resized, _ = resize_depth(depth, size=size, max_jump=max_jump)
    points = deproject_depth(resized, camera.resized(size).intrinsics)[0].double()
    error = ((points @ normal - offset).reshape(*size)).abs()
    # Half a pixel at the border is sampled outside the first centers, where the edge pixel stands for it.
    assert float(error[2:-2, 2:-2].max()) < (1e-6 if max_jump else 0.02)


def test_interpolation_stays_off_edges_and_holes():
    depth = torch.where(torch.arange(20) < 9, 0.5, 0.505).expand(1, 8, 20).clone()
    depth[..., 13:] = 1.0
    depth[0, 4, 4] = 0.0
    resized, _ = resize_depth(depth, size=(21, 47), max_jump=0.02)
    values = resized.flatten()
    on_surface = ((values >= 0.4999) & (values <= 0.5051)) | (values == 1.0) | (values == 0.0)
    assert bool(on_surface.all())
    between = (values > 0.5001) & (values < 0.5049)
    assert bool(between.any()), "the small step is one surface and is interpolated"
    nearest, _ = resize_depth(depth, size=(21, 47))
    assert torch.equal(resized == 0, nearest == 0)


def test_the_same_size_is_the_same_image():
    depth = noisy_image(9, 11)
    for max_jump in (None, 0.01, 10.0):
        torch.testing.assert_close(resize_depth(depth, size=(9, 11), max_jump=max_jump)[0], depth, rtol=2e-7, atol=0)


def test_bad_requests_are_refused():
    depth = noisy_image(6, 6)
    for factor in (0, 9, -1):
        with pytest.raises(ConfigError, match="decimate_depth: factor must be 1 to 8"):
            decimate_depth(depth, factor=factor)
    with pytest.raises(ConfigError, match="rule"):
        decimate_depth(depth, factor=2, rule="max")
    with pytest.raises(ShapeError, match="no block of 7 x 7"):
        decimate_depth(depth, factor=7)
    for size in ((0, 4), (4,), (4, -1)):
        with pytest.raises(ConfigError, match="resize_depth: size must be"):
            resize_depth(depth, size=size)
    with pytest.raises(ConfigError, match="max_jump"):
        resize_depth(depth, size=(4, 4), max_jump=0.0)
    with pytest.raises(CaptureError, match="negative"):
        resize_depth(-depth, size=(4, 4))
