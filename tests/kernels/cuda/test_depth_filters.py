"""Filters of depth images: the reference's bits, for images of any size, all holes, and windows beyond them."""

from __future__ import annotations

import pytest
import torch

from pcdata import functional as F
from pcdata.functional.depth.confidence import filled_confidence
from pcdata.functional.depth.disparity import reciprocals, smoothed_images
from pcdata.functional.depth.flying_pixels import without_flying_pixels
from pcdata.functional.depth.holes import fill_rows, filled_images
from pcdata.functional.depth.temporal import PERSISTENCE_RULES, temporal_step
from pcdata.rng import seeded
from tests.factories import assert_same
from tests.kernels.cuda import harness
from tests.kernels.cuda.inner_calls import depth_images

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()

SIZES = [(0, 4, 5), (1, 1, 1), (1, 1, 40), (2, 35, 1), (3, 2, 2), (2, 19, 23)]


def agree(function, *arguments, **options):
    found = function(*arguments, backend=harness.BACKEND, **options)
    assert_same(found, function(*arguments, backend="torch", **options))
    return found


def every(shape):
    """Images without, with some, and with nothing but holes; the second does not lie row after row."""
    yield depth_images(shape, holes=0.0)
    yield depth_images((shape[0], shape[2], shape[1]), seed=1, holes=0.4).transpose(1, 2)
    yield torch.zeros(shape)


@pytest.mark.parametrize("shape", SIZES)
def test_averages_along_lines(shape, ordered):
    for depth in every(shape):
        agree(F.spatial_filter, 1000 * depth, alpha=0.3, delta=25.0, iterations=2)
        agree(F.spatial_filter, depth, delta=torch.inf, iterations=1)
        scale = torch.linspace(20.0, 40.0, shape[0])
        agree(smoothed_images, depth, scale, 0.5, 1.0, 2)
        agree(reciprocals, depth, scale)


@pytest.mark.parametrize("persistence", range(len(PERSISTENCE_RULES)))
def test_averages_over_time(persistence, ordered):
    shape = (2, 7, 12)
    for scale in (None, torch.tensor([20.0, 30.0])):
        last = depth_images(shape, seed=5) if scale is None else 20 / depth_images(shape, seed=5).clamp(min=0.4)
        history = torch.randint(0, 256, shape, generator=seeded(6), dtype=torch.uint8)
        for depth in every(shape):
            agree(temporal_step, depth, scale, last, history, 0.4, 0.05, persistence)


@pytest.mark.parametrize("shape", SIZES)
def test_windows(shape, ordered):
    for depth in every(shape):
        for reach, jump in ((1, 0.02), (2, torch.inf), (3, 0.05)):
            agree(F.bilateral_filter, depth, reach=reach, max_jump=jump, sigma_depth=0.02)
            agree(F.median_filter, depth, reach=reach, max_jump=jump if reach > 1 else None)
    agree(F.median_filter, torch.full(shape, 0.5), reach=3)


@pytest.mark.parametrize("shape", SIZES)
def test_flying_pixels(shape, ordered):
    confidence = torch.randint(0, 4, shape, generator=seeded(2), dtype=torch.uint8)
    for depth in every(shape):
        for least in (1, 3, 8):
            agree(F.flying_pixel_mask, depth, tolerance=0.01, min_neighbors=least)
            agree(without_flying_pixels, depth, None if least == 1 else confidence, 0.02, least)


@pytest.mark.parametrize("shape", SIZES)
def test_holes(shape, ordered):
    lonely = torch.zeros(shape)
    lonely[..., 0] = 0.7
    for depth in (*every(shape), depth_images(shape, holes=0.9), lonely):
        for rule in ("left", "farthest", "nearest"):
            for size in (None, 1, 3, 100):
                agree(F.fill_holes, depth, rule=rule, max_size=size)
            agree(filled_images, depth, rule, None, 2)
        for radius in (1, 3, 1000):
            agree(fill_rows, depth, radius)


def test_what_is_filled_is_trusted_less(ordered):
    shape = (2, 9, 11)
    before = depth_images(shape, holes=0.4)
    after = torch.where(before > 0, before, 0.5)
    trust = torch.randint(0, 4, shape, generator=seeded(3), dtype=torch.uint8)
    far = torch.rand(shape, generator=seeded(4)) < 0.5
    for confidence in (None, trust):
        for marked in (None, far):
            agree(filled_confidence, before, after, confidence, marked)
    assert agree(filled_confidence, before, before, None, None) is None


@pytest.mark.parametrize("factor", [1, 2, 3, 5, 8])
def test_blocks_become_pixels(factor, ordered):
    for shape in ((1, 8, 8), (2, 17, 26)):
        for depth in (*every(shape), depth_images(shape, holes=0.8), torch.full(shape, 0.5)):
            agree(F.decimate_depth, depth, factor=factor)
            agree(F.decimate_depth, depth, factor=factor, rule="mean", max_jump=torch.inf)


@pytest.mark.parametrize("size", [(1, 1), (7, 30), (40, 13), (19, 23)])
def test_images_are_resized(size, ordered):
    for shape in ((1, 1, 1), (2, 19, 23)):
        for depth in every(shape):
            for jump in (None, 0.02, torch.inf):
                agree(F.resize_depth, depth, size=size, max_jump=jump)
